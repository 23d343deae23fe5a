"""Photos judged as they arrive: sharp, lit, with markers or not; hostile ones cost a child process and no more."""

from __future__ import annotations

import io
import os
import struct
import sys
import threading
import time
import typing
import zlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from specimap_core.arrays import Bytes
from specimap_core.errors import BackendUnavailableError
from specimap_core.photos.reading import AcquisitionSettings, read_photo
from specimap_core.pipeline.options import Dictionary
from specimap_core.screening.photo import Others, judge_photo
from specimap_infra.completeness import LEAST_PHOTOS
from specimap_infra.settings import load_settings
from specimap_service.acquisitions.judge import Judge
from tests.support.photo_files import bomb
from tests.support.service_scene import Running
from tests.support.upload_scene import client_at, key_in, new_acquisition, photos, process_serving, send, sent

SHARP = photos()


def jpeg(image: Bytes) -> bytes:
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert ok
    return data.tobytes()


def bgr(path: Path) -> Bytes:
    return np.asarray(cv2.imread(str(path)), np.uint8)


def defocused(image: Bytes, sigma: float) -> Bytes:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)


def shaken(image: Bytes, pixels: int, degrees: float) -> Bytes:
    line = np.zeros((pixels, pixels), np.float32)
    line[pixels // 2] = 1
    turn = cv2.getRotationMatrix2D(((pixels - 1) / 2, (pixels - 1) / 2), degrees, 1)
    kernel = cv2.warpAffine(line, turn, (pixels, pixels))
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)


def verdict_of(path: Path, data: bytes, dictionary: str = "DICT_4X4_50", others: Others | None = None) -> str:
    path.write_bytes(data)
    judged = judge_photo(path, dictionary, others or Others())
    assert judged.verdict == "accepted" or (judged.code and judged.reason.endswith(".") and judged.advice.endswith("."))
    return judged.code or "accepted"


@pytest.mark.slow
@pytest.mark.parametrize("path", SHARP[::4], ids=lambda p: p.name)
def test_sharp_and_blurred(path: Path, tmp_path: Path) -> None:
    image, at = bgr(path), tmp_path / "x"
    assert verdict_of(at, path.read_bytes()) == "accepted"
    for pixels, degrees in ((9, 0), (15, 30), (15, 45), (15, 90), (25, 70)):
        assert verdict_of(at, jpeg(shaken(image, pixels, degrees))) in ("photo_blurred", "no_markers_found")
    usual = Others([judge_photo(p, "DICT_4X4_50", Others()).facts["sharpness"] for p in SHARP[::6]])
    assert verdict_of(at, path.read_bytes(), others=usual) == "accepted"
    for bad in (defocused(image, 3), shaken(image, 15, 30), shaken(image, 15, 60), shaken(image, 25, 70)):
        assert verdict_of(at, jpeg(bad), others=usual) == "photo_blurred"


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["real_aruco_apple", "real_exif_rotated"])
def test_real_photos_sharp_and_blurred(data_dir: Path, folder: str, tmp_path: Path) -> None:
    for path in sorted((data_dir / folder / "images").glob("*.jpg"))[::8]:
        image = cv2.cvtColor(read_photo(path, AcquisitionSettings()).image, cv2.COLOR_RGB2BGR)
        at = tmp_path / "x"
        assert verdict_of(at, jpeg(np.asarray(image, np.uint8)), "DICT_7X7_1000") == "accepted"
        for bad in (defocused(image, 2.5), shaken(image, 9, 0), shaken(image, 15, 30), shaken(image, 25, 60)):
            assert verdict_of(at, jpeg(bad), "DICT_7X7_1000") == "photo_blurred"


@pytest.mark.slow
def test_light_size_and_markers(tmp_path: Path) -> None:
    image, at = bgr(SHARP[0]), tmp_path / "x"
    assert verdict_of(at, jpeg(np.asarray(np.clip(image.astype(int) * 3, 0, 255), np.uint8))) == "photo_overexposed"
    assert verdict_of(at, jpeg(np.asarray(image // 7, np.uint8))) == "photo_underexposed"
    assert verdict_of(at, jpeg(np.asarray(cv2.resize(image, (200, 200)), np.uint8))) == "photo_too_small"
    bare = np.asarray(cv2.resize(image[200:320, 200:320], (512, 512), interpolation=cv2.INTER_NEAREST), np.uint8)
    assert verdict_of(at, jpeg(bare)) == "no_markers_found"
    others = Others(sizes=[(4000, 3000), (3000, 4000), (4000, 3000)])
    assert verdict_of(at, SHARP[0].read_bytes(), others=others) == "photo_foreign"
    at.write_bytes(jpeg(np.ascontiguousarray(bgr(SHARP[0])[:, ::-1])))
    assert "mirrored" in judge_photo(at, "DICT_4X4_50", Others()).reason
    assert verdict_of(at, SHARP[0].read_bytes(), "DICT_APRILTAG_36h11") == "marker_dictionary_wrong"
    judged = judge_photo(SHARP[0], "DICT_APRILTAG_36h11", Others())
    assert (judged.verdict, judged.facts["dictionary_seen"]) == ("doubtful", "DICT_4X4_1000")
    one = np.full_like(image, 200)
    one[200:450, 200:450] = 90
    noise = np.random.default_rng(0).integers(0, 60, one.shape, dtype=np.uint8)
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 3, 80)
    one = np.asarray(one - noise, np.uint8)
    one[20:130, 20:130] = 230
    one[35:115, 35:115] = marker[..., None]
    assert verdict_of(at, jpeg(one)) == "few_markers"
    facts = judge_photo(at, "DICT_4X4_50", Others()).facts
    assert facts["marker_ids"] == [3]
    (marker,) = facts["markers"]
    assert marker["id"] == 3
    square = np.array([[34.5, 34.5], [114.5, 34.5], [114.5, 114.5], [34.5, 114.5]])
    assert np.abs(np.array(marker["corners"]) - square).max() < 0.3
    large = jpeg(np.asarray(cv2.resize(one, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST), np.uint8))
    at.write_bytes(large)
    corners = np.array(judge_photo(at, "DICT_4X4_50", Others()).facts["markers"][0]["corners"])
    assert np.abs(corners - ((square + 0.5) * 4 - 0.5)).max() < 1


def one_bit_bomb(side: int = 30_000) -> bytes:
    """A complete PNG of 110 kilobytes with 900 million pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, rows = zlib.compressobj(9), io.BytesIO()
    for _ in range(side):
        rows.write(packer.compress(b"\0" * (1 + side // 8)))
    rows.write(packer.flush())
    header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows.getvalue()) + chunk(b"IEND", b"")


def test_what_does_not_decode_is_kept_to_be_shown(service: Running, tmp_path: Path) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    whole = SHARP[0].read_bytes()
    bad = {
        "text.jpg": b"a letter, not a photo",
        "cut.jpg": whole[: len(whole) // 2],
        "bomb.png": one_bit_bomb(),
        "huge.png": bomb(tmp_path / "huge.png").read_bytes(),
        "script.ps": b"%!PS-Adobe-3.0\n(%pipe%id) (r) file\n",
        "x.svg": b"<svg onload='alert(1)'/>",
    }
    for number, (name, data) in enumerate(bad.items(), 1):
        file = sent(client, acquisition, "photo", name, data)
        assert (file["state"], file["judgement"]["code"]) == ("refused", "photo_unreadable"), name
        assert file["judgement"]["reason"].startswith("The photo ")
        assert file["label"].startswith(f"photo-{number:04d}.")
        assert file["name"] == name
    shown = client.get(f"/v1/acquisitions/{acquisition}").json()
    assert (shown["files"]["photos"], shown["files"]["refused"]) == (0, len(bad))
    content = client.get(f"/v1/acquisitions/{acquisition}/files/{file['id']}/content")
    assert content.headers["content-type"] == "application/octet-stream"
    assert "attachment" in content.headers["content-disposition"]
    assert sent(client, acquisition, "photo", "x.jpg", whole)["state"] == "accepted"


def test_same_photo_twice(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    data = SHARP[0].read_bytes()
    first = sent(client, acquisition, "photo", "a.jpg", data)
    second = sent(client, acquisition, "photo", "b.jpg", data)
    assert (second["state"], second["judgement"]["code"]) == ("refused", "photo_duplicate")
    assert second["judgement"]["same_as"] == first["label"]
    client.delete(f"/v1/acquisitions/{acquisition}/files/{first['id']}")
    assert sent(client, acquisition, "photo", "c.jpg", data)["state"] == "accepted"


def test_names_of_dictionaries_are_those_of_the_pipeline() -> None:
    names = typing.get_args(Dictionary)
    known = {getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}
    assert sorted(getattr(cv2.aruco, name) for name in names) == sorted(known)
    assert AcquisitionSettings().least_photos == LEAST_PHOTOS


# ---- the child ----------------------------------------------------------------------------------------

FAKE = """
import json, os, sys, time
WORDS = {"code": None, "reason": "", "advice": ""}
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    what = json.loads(line)["path"]
    if what == "crash": os.abort()
    if what == "hang": time.sleep(3600)
    if what == "garble": print("no json", flush=True)
    else: print(json.dumps({**WORDS, "verdict": "accepted", "pid": os.getpid()}), flush=True)
"""


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[Judge]:
    judge = Judge(load_settings(data_dir=tmp_path, judge_seconds=0.5), os.environ, (sys.executable, "-c", FAKE))
    yield judge
    judge.close()


def test_a_file_that_crashes_or_hangs_its_reader_is_refused(fake: Judge) -> None:
    for name, code in (("crash", "judging_crashed"), ("hang", "judging_too_slow"), ("garble", "judging_crashed")):
        first = fake.cube(Path("good"))["pid"]
        assert fake.cube(Path("good"))["pid"] == first
        for verdict in (fake.photo(Path(name), "x", [], []), fake.part(Path(name), "", None), fake.cube(Path(name))):
            assert (verdict["verdict"], verdict["code"]) == ("refused", code)
            assert verdict["advice"]
        assert fake.cube(Path("good"))["pid"] != first


def test_child_outlives_the_thread_that_asked_and_comes_back_when_killed(fake: Judge) -> None:
    pids: list[int] = []
    for _ in range(4):
        thread = threading.Thread(target=lambda: pids.append(fake.cube(Path("good"))["pid"]))
        thread.start()
        thread.join()
    assert len(set(pids)) <= 2
    for pid in set(pids):
        os.kill(pid, 9)
    deadline = time.monotonic() + 10
    while fake.cube(Path("good")).get("pid") in (None, *pids):
        assert time.monotonic() < deadline


def test_a_child_that_does_not_start_is_no_fault_of_the_file(tmp_path: Path) -> None:
    judge = Judge(load_settings(data_dir=tmp_path), os.environ, (sys.executable, "-c", "raise SystemExit(3)"))
    with pytest.raises(BackendUnavailableError, match="does not start"):
        judge.cube(Path("good"))
    judge.close()
    with pytest.raises(BackendUnavailableError, match="stopping"):
        judge.cube(Path("good"))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_child_has_no_keys_and_dies_with_the_service(tmp_path: Path) -> None:
    key = key_in(tmp_path)
    with process_serving(tmp_path) as (process, url), client_at(url, key) as client:
        assert send(client, new_acquisition(client), "photo", "x.jpg", SHARP[0].read_bytes()).status_code == 201
        children = [
            int(child)
            for task in Path(f"/proc/{process.pid}/task").iterdir()
            for child in (task / "children").read_text().split()
            if b"specimap_core.screening" in Path(f"/proc/{child}/cmdline").read_bytes()
        ]
        assert 1 <= len(children) <= 2
        environment = Path(f"/proc/{children[0]}/environ").read_bytes()
        assert not any(name in environment for name in (b"AWS", b"SPECIMAP", b"SECRET", b"PASSWORD"))
        assert b"Max address space" in Path(f"/proc/{children[0]}/limits").read_bytes()
        process.kill()
        process.wait()
        deadline = time.monotonic() + 10
        while any(alive(child) for child in children):
            assert time.monotonic() < deadline
            time.sleep(0.02)


def alive(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False

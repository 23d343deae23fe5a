"""Cubes and references judged as they arrive: header and data in any order, whole files, useless and hostile ones."""

from __future__ import annotations

import io
import os
import threading
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from specimap_core.screening.cube import judge_cube, judge_part
from specimap_infra.settings import load_settings
from specimap_service.acquisitions.judge import Judge
from tests.support.cube_files import random_values, write_envi
from tests.support.places import SAMPLES
from tests.support.service_scene import Running
from tests.support.upload_scene import new_acquisition, send, sent

HEADER = (SAMPLES / "hsi" / "hsi.hdr").read_bytes()
DATA = (SAMPLES / "hsi" / "hsi.raw").read_bytes()


def files_of(client: httpx.Client, acquisition: str) -> dict[str, dict[str, Any]]:
    return {file["label"]: file for file in client.get(f"/v1/acquisitions/{acquisition}/files").json()}


def npy(values: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()


@pytest.mark.parametrize("first", ["header", "data"])
def test_header_and_data_in_any_order(service: Running, first: str) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    parts = {"header": ("hsi.hdr", HEADER, "cube.hdr"), "data": ("hsi.raw", DATA, "cube.raw")}
    second = "data" if first == "header" else "header"
    one = sent(client, acquisition, "cube", *parts[first][:2])
    assert (one["label"], one["judgement"]["verdict"]) == (parts[first][2], "accepted")
    assert one["judgement"]["waiting_for"] == second
    assert not client.get(f"/v1/acquisitions/{acquisition}").json()["files"]["cube"]
    two = sent(client, acquisition, "cube", *parts[second][:2])
    assert two["label"] == parts[second][2]
    for file in files_of(client, acquisition).values():
        judged = file["judgement"]
        assert (judged["verdict"], judged["waiting_for"], judged["quantity"]) == ("accepted", None, "reflectance")
        assert (judged["rows"], judged["cols"], judged["bands"]) == (432, 464, 16)
        assert judged["wavelength_nm"] == [461.905, 1700.0]
    header = files_of(client, acquisition)["cube.hdr"]["judgement"]
    assert (header["interleave"], header["dtype"], header["expected_bytes"]) == ("bsq", "uint16", len(DATA))
    state = client.get(f"/v1/acquisitions/{acquisition}").json()
    assert state["files"]["cube"]
    assert state["missing"] == ["0 usable photos; at least 6 are needed."]
    conflict = send(client, acquisition, "cube", "other.raw", DATA[:100])
    assert (conflict.status_code, conflict.json()["code"]) == (409, "state_conflict")
    assert conflict.json()["details"]["label"] == "cube.raw"
    assert client.delete(f"/v1/acquisitions/{acquisition}/files/{two['id']}").status_code == 204
    assert files_of(client, acquisition)[parts[first][2]]["judgement"]["waiting_for"] == second


@pytest.mark.parametrize("first", ["header", "data"])
def test_data_that_are_too_short(service: Running, first: str) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    short = ("x.raw", DATA[:-2])
    if first == "header":
        sent(client, acquisition, "cube", "x.hdr", HEADER)
        data = sent(client, acquisition, "cube", *short)
    else:
        sent(client, acquisition, "cube", *short)
        header = sent(client, acquisition, "cube", "x.hdr", HEADER)["judgement"]
        assert (header["verdict"], header["code"], header["waiting_for"]) == ("doubtful", "cube_truncated", "data")
        data = files_of(client, acquisition)["refused-cube-0001.raw"]
    judged = data["judgement"]
    assert (data["state"], data["label"], judged["code"]) == ("refused", "refused-cube-0001.raw", "cube_truncated")
    assert (judged["found_bytes"], judged["expected_bytes"]) == (len(DATA) - 2, len(DATA))
    assert (
        "The cube's data file (cube.raw) has not arrived."
        in (client.get(f"/v1/acquisitions/{acquisition}").json()["missing"])
    )
    assert sent(client, acquisition, "cube", "x.raw", DATA)["judgement"]["verdict"] == "accepted"
    assert files_of(client, acquisition)["cube.hdr"]["judgement"]["verdict"] == "accepted"


def test_headers_that_are_none_or_wrong(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    bad = (
        (b"a letter", "ENVI"),
        (HEADER.replace(b"bsq", b"bup"), "interleave"),
        (HEADER[:40], "description"),
        (HEADER.replace(b"samples = 464", b"samples = -4"), "samples"),
        (bytes(range(256)), "ENVI"),
    )
    for number, (data, field) in enumerate(bad, 1):
        file = sent(client, acquisition, "cube", "x.HDR", data)
        judged = file["judgement"]
        assert (file["state"], file["label"]) == ("refused", f"refused-cube-{number:04d}.hdr")
        assert (judged["code"], judged["field"]) == ("cube_header_invalid", field)
        assert judged["advice"]
        assert "cube.hdr" not in judged["reason"] + judged["advice"]
    assert sent(client, acquisition, "cube", "x.hdr", HEADER)["label"] == "cube.hdr"


def test_whole_files_and_useless_ones(service: Running, tmp_path: Path) -> None:
    client = service.client()
    good = random_values("u2", (30, 20, 8))
    np.savez(tmp_path / "x.npz", cube=good)
    for name, data, label in (
        ("x.npy", npy(good), "cube.npy"),
        ("scan", npy(good), "cube.npy"),
        ("x.npz", (tmp_path / "x.npz").read_bytes(), "cube.npz"),
    ):
        acquisition = new_acquisition(client)
        file = sent(client, acquisition, "cube", name, data)
        assert (file["label"], file["judgement"]["verdict"], file["judgement"]["bands"]) == (label, "accepted", 8)
        assert client.get(f"/v1/acquisitions/{acquisition}").json()["files"]["cube"]
        assert send(client, acquisition, "cube", "x.hdr", HEADER).status_code == 409
    acquisition = new_acquisition(client)
    for name, data, code in (
        ("x.npy", npy(np.full((9, 8, 3), np.nan, "f4")), "cube_content_invalid"),
        ("x.npy", npy(np.zeros((9, 8, 3), "u2")), "cube_content_invalid"),
        ("x.npy", npy(good)[:-9], "cube_truncated"),
        ("x.npy", npy(good[0]), "cube_format_unknown"),
        ("x.h5", b"no HDF5", "cube_format_unknown"),
        ("x.mat", b"MATLAB 5.0 MAT-file" + bytes(200), "cube_format_unknown"),
    ):
        file = sent(client, acquisition, "cube", name, data)
        assert (file["state"], file["judgement"]["code"]) == ("refused", code), name
    assert client.get(f"/v1/acquisitions/{acquisition}").json()["files"]["refused"] == 6


def test_references_must_fit_the_cube(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    sent(client, acquisition, "dark", "d.npy", npy(random_values("u2", (3, 20, 8))))
    sent(client, acquisition, "cube", "c.npy", npy(random_values("u2", (30, 20, 8))))
    assert (
        "The dark reference has no white one beside it."
        in (client.get(f"/v1/acquisitions/{acquisition}").json()["missing"])
    )
    other = sent(client, acquisition, "white", "w.npy", npy(random_values("u2", (3, 20, 9))))
    assert (other["state"], other["judgement"]["code"]) == ("refused", "cube_content_invalid")
    assert "9 bands" in other["judgement"]["reason"]
    assert sent(client, acquisition, "white", "w.npy", npy(random_values("u2", (3, 1, 8))))["label"] == "white.npy"
    counts = client.get(f"/v1/acquisitions/{acquisition}").json()["files"]
    assert (counts["cube"], counts["white"], counts["dark"], counts["refused"]) == (True, True, True, 1)
    acquisition = new_acquisition(client)
    sent(client, acquisition, "white", "w.npy", npy(random_values("u2", (3, 20, 9))))
    late = sent(client, acquisition, "cube", "c.npy", npy(random_values("u2", (30, 20, 8))))["judgement"]
    assert (late["verdict"], late["code"]) == ("doubtful", "cube_content_invalid")


def test_both_parts_at_the_same_time(service: Running) -> None:
    client = service.client()
    for _ in range(4):
        acquisition = new_acquisition(client)
        both = [
            threading.Thread(target=send, args=(service.client(), acquisition, "cube", name, data))
            for name, data in (("x.hdr", HEADER), ("x.raw", DATA[:-2]))
        ]
        for thread in both:
            thread.start()
        for thread in both:
            thread.join()
        files = files_of(client, acquisition)
        assert set(files) == {"cube.hdr", "refused-cube-0001.raw"}
        assert files["refused-cube-0001.raw"]["judgement"]["code"] == "cube_truncated"


def mutated(text: bytes, rng: np.random.Generator) -> bytes:
    """A header with a few things wrong: bytes, lines, numbers."""
    lines = text.splitlines()
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        kind = rng.integers(6)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(at, rng.bytes(int(rng.integers(1, 60))))
        elif kind == 2:
            number = rng.choice([b"0", b"-1", b"2147483647", b"999999999999999999", b"1e9", b"nan", b"7", b"1"])
            lines[at] = lines[at].partition(b"=")[0] + b"= " + bytes(number)
        elif kind == 3:
            lines[at] = lines[at] + b" {" * int(rng.integers(1, 2000))
        elif kind == 4:
            lines.append(rng.choice([b"file compression = 1", b"header offset = 99", b"bbl = {0}", b"data type = 5"]))
        else:
            lines[at] = bytes(b ^ int(rng.integers(256)) if rng.random() < 0.05 else b for b in lines[at])
        lines = lines or [b""]
    return b"\n".join(lines)


@pytest.mark.slow
def test_a_thousand_hostile_cubes(tmp_path: Path) -> None:
    """All of them by the functions that judge, and some through a judging process, which says the same."""
    settings = load_settings(data_dir=tmp_path, judge_seconds=10, judge_memory_bytes=256 * 1024**2)
    settings.scratch.mkdir(parents=True)
    judge = Judge(settings, os.environ)
    rng = np.random.default_rng(0)
    header = write_envi(tmp_path / "cube.hdr", random_values("u2", (12, 10, 6)), wavelength="{1,2,3,4,5,6}")
    text, data = header.read_bytes(), header.with_suffix(".raw").read_bytes()
    whole = npy(random_values("f4", (12, 10, 6)))
    codes: dict[str | None, int] = {}
    try:
        for k in range(1000):
            if k % 4:
                header.write_bytes(mutated(text, rng))
                header.with_suffix(".raw").write_bytes(data[: int(rng.integers(len(data) * 2))])
                path = header
            else:
                path = tmp_path / "cube.npy"
                damaged = bytearray(whole)
                for at in rng.integers(0, 140, 2):
                    damaged[at] = rng.choice(list(b"0123456789<>|,u1f8 "))
                path.write_bytes(damaged)
            verdict = judge_part(path, path.suffix, None).as_dict()
            if verdict["verdict"] != "refused":
                verdict = judge_cube(path).as_dict()
            assert verdict["verdict"] in ("accepted", "doubtful", "refused")
            if k % 10 < 2:
                heard = judge.part(path, path.suffix, None)
                heard = judge.cube(path) if heard["verdict"] != "refused" else heard
                assert (heard["verdict"], heard["code"]) == (verdict["verdict"], verdict["code"])
            assert verdict["verdict"] == "accepted" or (verdict["code"] and verdict["reason"] and verdict["advice"])
            codes[verdict["code"]] = codes.get(verdict["code"], 0) + 1
    finally:
        judge.close()
    # Every kind of refusal occurs, and none of the files brought the reader down.
    assert set(codes) >= {None, "cube_header_invalid", "cube_truncated", "cube_format_unknown"}
    assert min(codes[code] for code in (None, "cube_header_invalid", "cube_truncated")) >= 50
    assert not {"judging_crashed", "judging_too_slow"} & set(codes)

"""DICOM in: segmentations become label layers, photos become acquisitions, and all else is refused."""

from __future__ import annotations

import shutil
import socket
import subprocess
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.config import disable_value_validation
from pydicom.dataset import FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, JPEGBaseline8Bit, generate_uid

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud
from specimap_hospital.dicom.canvas import Canvas
from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.outbox.instances import take_stock
from specimap_hospital.outbox.making import make_objects
from specimap_hospital.outbox.rows import Claim, claim, request_set
from specimap_hospital.receive.classes import CANNOT_PROCESS, CANNOT_UNDERSTAND
from specimap_hospital.receive.listener import start_listener
from specimap_infra.database import utc_now
from tests.support.hospital_scene import KEY, PLANTED, as_json
from tests.support.label_files import header, layer, npy
from tests.support.outbox_scene import with_settings
from tests.support.places import SAMPLES
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving

STUDIES = "/v1/dicomweb/studies"
SEGMENTATION, PHOTOGRAPH = "1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.77.1.4"


@dataclass
class Scene:
    """A result whose objects the archive has, and what they were."""

    running: Running
    result: Result
    objects: dict[str, Dataset]
    canvas: Canvas


def corners_of(result: Result) -> Array:
    import json

    return np.array(list(json.loads((result.local / "corners.json").read_text()).values()), float)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("receive")
    with serving(folder / "service", study_keys=[KEY], stow="on", pacs_url="http://127.0.0.1:9") as running:
        result = put_result(running, folder / "result")
        classes = np.array([0, 1, 700], np.uint16)[np.arange(result.cloud.n_points) // 40 % 3]
        client = running.client()
        put = client.put(layer(result), content=npy(classes), headers=header())
        assert put.status_code == 201, put.text
        assert client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=as_json()).status_code == 200
        objects: dict[str, Dataset] = {}
        for number, options in enumerate(({}, {"label": "tissue"})):
            for made in as_sent(running, result, options, folder / f"made-{number}"):
                objects[made.kind] = dcmread(made.path)
        cloud = Cloud.open(result.local / "cloud.zarr")
        yield Scene(running, result, objects, Canvas.of(cloud, corners_of(result)))


def as_sent(running: Running, result: Result, options: dict[str, Any], folder: Path) -> list[DicomObject]:
    """Make objects, and let the outbox know them as a sender does."""
    import datetime

    with running.database.session() as session:
        request_set(session, result.cloud_id, options, "key_test", utc_now(), again=True)
    held = claim(running.database, "test", utc_now(), datetime.timedelta(hours=1), ("waiting",))
    assert isinstance(held, Claim)
    assert held.options == options
    made = make_objects(running.database, running.storage, running.settings, result.cloud_id, options, folder)
    take_stock(running.database, held, made)
    return made


def encoded(dataset: Dataset, syntax: str = ExplicitVRLittleEndian) -> bytes:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = dataset.SOPClassUID, dataset.SOPInstanceUID
    meta.TransferSyntaxUID = UID(syntax)
    dataset.file_meta = meta
    target = BytesIO()
    dataset.save_as(target, enforce_file_format=True)
    return target.getvalue()


def stow(client: httpx.Client, *objects: bytes) -> httpx.Response:
    body = b"".join(b"\r\n--b\r\nContent-Type: application/dicom\r\n\r\n" + item for item in objects) + b"\r\n--b--\r\n"
    kind = 'multipart/related; type="application/dicom"; boundary=b'
    return client.post(STUDIES, content=body[2:], headers={"Content-Type": kind, "Accept": "application/dicom+json"})


def failures(answer: httpx.Response) -> list[int]:
    return [item["00081197"]["Value"][0] for item in answer.json().get("00081198", {}).get("Value", [])]


def label_map(scene: Scene, labels: Array, source: str = "top_view") -> Dataset:
    """A classifier's answer: the class of each pixel of an object of the result."""
    made = Dataset()
    made.SOPClassUID, made.SOPInstanceUID = UID(SEGMENTATION), generate_uid()
    made.Modality, made.ContentLabel, made.ManufacturerModelName = "SEG", "NET_3D", "net"
    made.SoftwareVersions = "1.4"
    made.SegmentationType, made.NumberOfFrames = "LABELMAP", 1
    made.Rows, made.Columns = labels.shape
    made.SamplesPerPixel, made.PhotometricInterpretation = 1, "MONOCHROME2"
    made.BitsAllocated = made.BitsStored = 8
    made.HighBit, made.PixelRepresentation = 7, 0
    made.PixelData = labels.astype(np.uint8).tobytes() + b"\0" * (labels.size % 2)
    made.SegmentSequence = []
    for number in range(1, 5):
        item = Dataset()
        item.SegmentNumber, item.SegmentLabel = number, f"class {number}"
        made.SegmentSequence.append(item)
    series, instance = Dataset(), Dataset()
    instance.ReferencedSOPInstanceUID = scene.objects[source].SOPInstanceUID
    series.ReferencedInstanceSequence = [instance]
    made.ReferencedSeriesSequence = [series]
    return made


def photograph(study: str, number: int = 0) -> Dataset:
    photo = sorted((SAMPLES / "rgb").glob("*.jpg"))[number]
    made = Dataset()
    made.SOPClassUID, made.SOPInstanceUID = UID(PHOTOGRAPH), generate_uid()
    made.StudyInstanceUID, made.SeriesInstanceUID = study, generate_uid()
    made.PatientName, made.PatientID = "Doe^Jane^Quasimodo", "PID-0815-XYZ"
    made.Modality, made.SamplesPerPixel, made.PhotometricInterpretation = "XC", 3, "YBR_FULL_422"
    made.Rows, made.Columns = 960, 1280
    made.BitsAllocated = made.BitsStored = 8
    made.HighBit, made.PixelRepresentation, made.PlanarConfiguration = 7, 0, 0
    made.PixelData = encapsulate([photo.read_bytes()])
    made["PixelData"].is_undefined_length = True
    return made


def values_of(scene: Scene, name: str) -> Array:
    answer = scene.running.client().get(
        f"/v1/clouds/{scene.result.cloud_id}/labels/{name}/values", headers={"Accept": "application/x-npy"}
    )
    assert answer.status_code == 200, answer.text
    values: Array = np.load(BytesIO(answer.content), allow_pickle=False)
    return values


# ---- segmentations ------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["top_view", "preview", "reference_image"])
def test_a_pixels_class_comes_to_the_points_that_it_shows(scene: Scene, source: str) -> None:
    row, col = np.mgrid[: scene.canvas.rows, : scene.canvas.cols]
    labels = ((row * 7 + col * 13) % 5).astype(np.uint8)
    answer = stow(scene.running.client(["upload", "label"]), encoded(label_map(scene, labels, source)))
    assert answer.status_code == 200, answer.text
    assert list(answer.json()) == ["00081199"]
    values = values_of(scene, "net_3d")
    xy = scene.result.cloud.xyz[:, :2].astype(float)
    at = np.rint(scene.canvas.pixels(xy)).astype(int)
    top = scene.canvas.view.top
    # Where a point lies half-way between two pixels, rounding decides; there are few.
    same = values[top] == labels[at[:, 1], at[:, 0]][top]
    assert same.mean() > 0.999
    assert not values[~top].any()
    assert len(np.unique(values)) == 5
    described = scene.running.client().get(f"/v1/clouds/{scene.result.cloud_id}/labels/net_3d").json()
    assert [item["name"] for item in described["classes"]] == ["unlabelled", *(f"class {n}" for n in range(1, 5))]
    assert (described["made_by"]["name"], described["made_by"]["version"]) == ("net", "1.4")


def test_a_segmentation_of_our_own_comes_back_as_it_was(scene: Scene) -> None:
    answer = stow(scene.running.client(["upload", "label"]), encoded(scene.objects["segmentation"]))
    assert answer.status_code == 200, answer.text
    client = scene.running.client()
    names = [label["name"] for label in client.get(f"/v1/clouds/{scene.result.cloud_id}/labels").json()]
    (name,) = set(names) - {"tissue", "net_3d"}
    came = values_of(scene, name)
    went = values_of(scene, "tissue")
    order = np.argsort(-scene.result.cloud.xyz[:, 2], kind="stable")
    _, first = np.unique(scene.canvas.view.cell[order], return_index=True)
    highest = order[first]
    numbers = {int(number): int(np.bincount(came[highest][went[highest] == number]).argmax()) for number in (0, 1, 700)}
    assert len(set(numbers.values())) == 3, "each class stays apart"
    assert (came[highest] == np.vectorize(numbers.get)(went[highest])).all()


def test_a_segmentation_of_something_else_is_refused(scene: Scene) -> None:
    client = scene.running.client(["upload", "label"])
    labels = np.ones((scene.canvas.rows, scene.canvas.cols), np.uint8)
    strange = label_map(scene, labels)
    strange.ReferencedSeriesSequence[0].ReferencedInstanceSequence[0].ReferencedSOPInstanceUID = "2.25.1"
    other_size = label_map(scene, labels[1:])
    unknown_class = label_map(scene, labels * 9)
    elsewhere = label_map(scene, labels)
    groups, position, turned = Dataset(), Dataset(), Dataset()
    x, y = scene.canvas.first_pixel_mm
    position.ImagePositionPatient = [x + scene.canvas.grid_mm, y, 0]
    turned.ImageOrientationPatient = [1, 0, 0, 0, -1, 0]
    groups.PlanePositionSequence, groups.PlaneOrientationSequence = [position], [turned]
    elsewhere.PerFrameFunctionalGroupsSequence = [groups]
    answer = stow(client, *map(encoded, (strange, other_size, unknown_class, elsewhere)))
    assert answer.status_code == 409
    assert failures(answer) == [0x0112, 0x0110, 0xC000, 0x0110]
    allowed = stow(scene.running.client(["upload"]), encoded(label_map(scene, labels)))
    assert (allowed.status_code, failures(allowed)) == (409, [0x0124])
    project = scene.running.project("elsewhere")
    hidden = stow(scene.running.client(["upload", "label"], project=project), encoded(label_map(scene, labels)))
    assert (hidden.status_code, failures(hidden)) == (409, [0x0112])


# ---- photos -------------------------------------------------------------------------------------------


def test_the_photos_of_a_study_become_an_acquisition(scene: Scene) -> None:
    client = scene.running.client(["upload", "read"])
    before = {item["id"] for item in client.get("/v1/acquisitions").json()["items"]}
    study = generate_uid()
    photos = [encoded(photograph(study, number), JPEGBaseline8Bit) for number in range(2)]
    assert stow(client, *photos).status_code == 200
    assert stow(client, photos[0]).status_code == 200, "one that is sent again is there already"
    (acquisition,) = [item for item in client.get("/v1/acquisitions").json()["items"] if item["id"] not in before]
    assert acquisition["files"]["photos"] == 2
    assert not any(text in str(acquisition) for text in PLANTED)
    known = client.get(f"/v1/acquisitions/{acquisition['id']}/study").json()["study"]
    assert (known["patient_name"], known["study_instance_uid"]) == ("Doe^Jane^Quasimodo", str(study))
    other = stow(client, encoded(photograph(generate_uid(), 2), JPEGBaseline8Bit))
    assert other.status_code == 200
    assert len(client.get("/v1/acquisitions").json()["items"]) == len(before) + 2


def test_photos_that_do_not_say_whose_they_are_or_name_two_patients_are_refused(scene: Scene) -> None:
    client = scene.running.client(["upload", "read"])
    before = len(client.get("/v1/acquisitions").json()["items"])
    unknown = photograph("")
    assert failures(stow(client, encoded(unknown, JPEGBaseline8Bit))) == [CANNOT_UNDERSTAND]
    for patient in ("P" * 65, "P\\Q"):
        unread = photograph(generate_uid(), 1)
        with disable_value_validation():
            unread.add_new("PatientID", "LO", patient)
            content = encoded(unread, JPEGBaseline8Bit)
        assert failures(stow(client, content)) == [CANNOT_UNDERSTAND], patient
    assert len(client.get("/v1/acquisitions").json()["items"]) == before
    study = generate_uid()
    assert stow(client, encoded(photograph(study, 1), JPEGBaseline8Bit)).status_code == 200
    other = photograph(study, 2)
    other.PatientID = "SOMEBODY-ELSE"
    assert failures(stow(client, encoded(other, JPEGBaseline8Bit))) == [CANNOT_PROCESS]
    assert len(client.get("/v1/acquisitions").json()["items"]) == before + 1


# ---- what is refused ----------------------------------------------------------------------------------


def deflated() -> bytes:
    """An object of some kilobytes that inflates to a gigabyte."""
    whole = encoded(photograph("2.25.5"), JPEGBaseline8Bit)
    meta = dcmread(BytesIO(whole)).file_meta
    meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    head = BytesIO()
    from pydicom.filewriter import write_file_meta_info

    head.write(b"\0" * 128 + b"DICM")
    write_file_meta_info(head, meta)  # type: ignore[arg-type]
    deflate = zlib.compressobj(9, wbits=-15)
    return head.getvalue() + b"".join(deflate.compress(bytes(1 << 20)) for _ in range(1024)) + deflate.flush()


def nested(depth: int = 20_000) -> bytes:
    """An object whose items lie in each other without end."""
    made = photograph("2.25.6")
    del made.PixelData
    sequence, item = b"\x40\x00\x75\x02SQ\0\0\xff\xff\xff\xff", b"\xfe\xff\x00\xe0\xff\xff\xff\xff"
    return encoded(made) + (sequence + item) * depth


def huge() -> bytes:
    made = photograph("2.25.7")
    made.Rows = made.Columns = 60000
    made.PhotometricInterpretation = "RGB"
    made.PixelData = bytes(64)
    made["PixelData"].is_undefined_length = False
    return encoded(made)


def strange_class() -> bytes:
    made = photograph("2.25.8")
    made.SOPClassUID = UID("1.2.840.10008.5.1.4.1.1.2")
    return encoded(made, JPEGBaseline8Bit)


def no_picture() -> bytes:
    made = photograph("2.25.9")
    made.PixelData = encapsulate([b"no picture at all"])
    made["PixelData"].is_undefined_length = True
    return encoded(made, JPEGBaseline8Bit)


@pytest.mark.parametrize(
    ("make", "failure"),
    [
        (lambda: b"garbage" * 100, 0xC000),
        (lambda: encoded(photograph("2.25.4"), JPEGBaseline8Bit)[:-3000], None),
        (deflated, 0x0122),
        (huge, 0x0110),
        (strange_class, 0x0122),
        (no_picture, 0x0110),
        (lambda: b"", 0xC000),
    ],
    ids=["garbage", "cut", "deflated", "huge", "class", "no picture", "empty"],
)
def test_what_is_none_is_refused_and_the_others_are_taken(
    scene: Scene, make: Callable[[], bytes], failure: int | None
) -> None:
    client = scene.running.client(["upload"])
    bad, good = make(), encoded(photograph(generate_uid(), 3), JPEGBaseline8Bit)
    answer = stow(client, bad, good)
    assert answer.status_code == 202, answer.text
    assert failures(answer) in ([failure], [0xC000], [0x0110]) if failure is None else failures(answer) == [failure]
    assert len(answer.json()["00081199"]["Value"]) == 1
    assert stow(client, bad).status_code == 409
    assert not list(scene.running.settings.scratch.glob("dicom-*"))


def test_deeply_nested_objects_do_no_harm(scene: Scene) -> None:
    answer = stow(scene.running.client(["upload"]), nested())
    assert (answer.status_code, failures(answer)) == (409, [0xC000])


@pytest.mark.parametrize(
    ("body", "kind", "status", "code"),
    [
        (b"x", "application/json", 415, "media_type_unsupported"),
        (b"x", 'multipart/related; type="application/dicom"', 415, "media_type_unsupported"),
        (b"x", 'multipart/related; type="image/jpeg"; boundary=b', 415, "media_type_unsupported"),
        (b"", 'multipart/related; type="application/dicom"; boundary=b', 422, "request_invalid"),
        (b"x", 'multipart/related; type="application/dicom"; boundary=b', 422, "request_invalid"),
        (b"--b--", 'multipart/related; type="application/dicom"; boundary=b', 422, "request_invalid"),
        (b"--b\r\n\r\nx\r\n--b--", 'multipart/related; type="application/dicom"; boundary=b', 422, "request_invalid"),
        (b"--b\r\nContent-Type: application/dicom\r\n\r\nx", "multipart/related; boundary=b", 422, "request_invalid"),
    ],
)
def test_a_body_that_does_not_read_is_refused(scene: Scene, body: bytes, kind: str, status: int, code: str) -> None:
    answer = scene.running.client().post(STUDIES, content=body, headers={"Content-Type": kind})
    assert (answer.status_code, answer.json()["code"]) == (status, code)


def test_a_body_beyond_the_limit_is_refused_and_all_of_it_is_off_by_default(tmp_path: Path) -> None:
    with serving(tmp_path / "small", stow="on", most_dicom_bytes=1000) as running:
        answer = stow(running.client(), b"x" * 2000)
        assert (answer.status_code, answer.json()["code"]) == (413, "payload_too_large")
    with serving(tmp_path / "off") as running:
        assert stow(running.client(), b"x").status_code == 404


# ---- the DICOM port -----------------------------------------------------------------------------------


def test_storescu_sends_to_the_dicom_port(scene: Scene, tmp_path: Path) -> None:
    program = shutil.which("storescu")
    if program is None:
        pytest.skip("there is no storescu: apt-get install dcmtk")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    settings = with_settings(
        scene.running.settings,
        dicom_port=port,
        dicom_peers=["CLASSIFIER"],
        dicom_key=scene.running.key(["upload", "label"]),
        dicom_forward_url=scene.running.url,
    )
    row, col = np.mgrid[: scene.canvas.rows, : scene.canvas.cols]
    segmentation = label_map(scene, ((row + col) % 3).astype(np.uint8))
    segmentation.ContentLabel = "BY_CSTORE"
    (tmp_path / "good.dcm").write_bytes(encoded(segmentation))
    segmentation.SOPInstanceUID = generate_uid()
    segmentation.ReferencedSeriesSequence[0].ReferencedInstanceSequence[0].ReferencedSOPInstanceUID = "2.25.1"
    (tmp_path / "bad.dcm").write_bytes(encoded(segmentation))

    def send(name: str, title: str = "CLASSIFIER") -> subprocess.CompletedProcess[str]:
        command = [program, "-R", "-v", "-aet", title, "-aec", "SPECIMAP", "127.0.0.1", str(port), str(tmp_path / name)]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    stop = start_listener(scene.running.database, settings)
    try:
        end = utc_now().timestamp() + 20
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert utc_now().timestamp() < end
        taken = send("good.dcm")
        assert "Received Store Response (Success)" in taken.stdout + taken.stderr
        assert len(np.unique(values_of(scene, "by_cstore"))) == 3
        refused = send("bad.dcm")
        assert "CannotUnderstand" in refused.stdout + refused.stderr
        stranger = send("good.dcm", "STRANGER")
        assert "Rejected" in stranger.stdout + stranger.stderr
    finally:
        stop()

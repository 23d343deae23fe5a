"""The tus protocol: what is advertised, who may do what, limits, checksums, ending and expiry."""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
import sqlalchemy as sa
import structlog
import tifffile
from scipy import io as scipy_io

from specimap_infra.database import utc_now
from specimap_infra.tables import Upload
from specimap_service.uploads.sweeping import sweep
from tests.support.cube_files import random_values
from tests.support.places import SAMPLES
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import TUS, create, created, metadata, new_acquisition, offset_of, patch, photos, result

PHOTO = photos()[0].read_bytes()


def test_abilities_are_those_that_are_there(service: Running) -> None:
    client = service.client()
    answer = client.options("/v1/uploads")
    assert answer.status_code == 204
    assert answer.headers["Tus-Version"] == "1.0.0"
    assert answer.headers["Tus-Extension"] == "creation,checksum,expiration,termination"
    assert answer.headers["Tus-Checksum-Algorithm"] == "sha1,sha256,md5"
    assert int(answer.headers["Tus-Max-Size"]) == service.settings.max_cube_bytes
    acquisition = new_acquisition(client)
    for header in ({"Upload-Concat": "partial"}, {"Upload-Defer-Length": "1"}):
        assert create(client, acquisition, "photo", 10, **header).json()["code"] == "request_invalid"
    fields = metadata(acquisition=acquisition, role="photo")
    answer = client.post(
        "/v1/uploads", content=b"x" * 10, headers={**TUS, "Upload-Length": "10", "Upload-Metadata": fields}
    )
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert list((service.settings.scratch / "uploads").iterdir()) == []


def test_photo_in_three_pieces_is_judged_at_the_last(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    at = created(client, acquisition, "photo", len(PHOTO), "IMG 1.jpg")
    assert at.startswith("/v1/uploads/up_")
    third = len(PHOTO) // 3
    for k in (0, 1):
        answer = patch(client, at, PHOTO[k * third : (k + 1) * third], k * third)
        assert answer.status_code == 204
        assert int(answer.headers["Upload-Offset"]) == (k + 1) * third == offset_of(client, at)
        assert "Specimap-Verdict" not in answer.headers
        assert "GMT" in answer.headers["Upload-Expires"]
    assert result(client, at)["state"] == "open"
    answer = patch(client, at, PHOTO[2 * third :], 2 * third)
    assert (answer.status_code, answer.headers["Specimap-Verdict"]) == (204, "accepted")
    described = result(client, at)
    assert (described["state"], described["error"]) == ("finished", None)
    assert described["file"]["id"] == answer.headers["Specimap-File"]
    assert described["file"]["sha256"] == hashlib.sha256(PHOTO).hexdigest()
    assert (described["file"]["label"], described["file"]["name"]) == ("photo-0001.jpg", "IMG 1.jpg")
    head = client.head(at, headers=TUS)
    assert head.headers["Upload-Offset"] == head.headers["Upload-Length"] == str(len(PHOTO))
    assert head.headers["Upload-Metadata"] == metadata(acquisition=acquisition, role="photo", filename="IMG 1.jpg")
    # The answer to the last piece got lost: sending nothing once more tells the same.
    again = patch(client, at, b"", len(PHOTO))
    assert (again.status_code, again.headers["Specimap-File"]) == (204, described["file"]["id"])
    assert client.get(f"/v1/acquisitions/{acquisition}").json()["files"]["photos"] == 1
    stored = client.get(f"/v1/acquisitions/{acquisition}/files/{described['file']['id']}/content")
    assert stored.content == PHOTO
    assert list((service.settings.scratch / "uploads").iterdir()) == []
    audited = client.get("/v1/audit", params={"target": described["file"]["id"]}).json()["items"]
    assert [entry["action"] for entry in audited] == ["file.create"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Tus-Resumable": "0.2.2"}, 412),
        ({"Content-Type": "application/octet-stream"}, 415),
        ({"Upload-Offset": "-1"}, 400),
        ({"Upload-Offset": "x"}, 400),
        ({"Upload-Offset": "7"}, 409),
        ({"Upload-Checksum": "sha256 !"}, 400),
        ({"Upload-Checksum": "crc32 AAAA"}, 400),
    ],
)
def test_wrong_requests_append_nothing(service: Running, headers: dict[str, str], status: int) -> None:
    client = service.client()
    at = created(client, new_acquisition(client), "photo", 100)
    answer = patch(client, at, b"x" * 50, 0, **headers)
    assert answer.status_code == status, answer.text
    assert answer.json()["advice"]
    assert answer.headers["Tus-Resumable"] == "1.0.0"
    assert offset_of(client, at) == 0


def test_more_than_announced_is_refused(service: Running) -> None:
    client = service.client()
    at = created(client, new_acquisition(client), "photo", 100)
    assert patch(client, at, b"x" * 101, 0).status_code == 409
    assert offset_of(client, at) == 0
    assert patch(client, at, iter([b"x" * 60, b"x" * 60]), 0).status_code == 400  # streamed: no length in advance
    assert offset_of(client, at) <= 60


def test_only_the_key_that_created_it_or_an_administrator(service: Running) -> None:
    owner, other, admin = service.client(["upload", "read"]), service.client(["upload", "read"]), service.client()
    acquisition = new_acquisition(owner)
    at = created(owner, acquisition, "photo", 100)
    assert create(service.client(["read"]), acquisition, "photo", 100).json()["code"] == "forbidden"
    assert other.head(at, headers=TUS).status_code == 403
    assert patch(other, at, b"x" * 10, 0).json()["code"] == "forbidden"
    assert other.get(f"{at}/result").status_code == 403
    assert other.delete(at, headers=TUS).status_code == 403
    assert offset_of(owner, at) == 0
    assert patch(admin, at, b"x" * 10, 0).status_code == 204
    del owner.headers["Authorization"]
    assert patch(owner, at, b"x" * 10, 10).status_code == 401
    assert owner.options("/v1/uploads").status_code == 401
    assert offset_of(admin, at) == 10


@pytest.mark.slow
def test_checksums(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    at = created(client, acquisition, "cube", 9_000_000, "x.raw")
    data = bytes(range(256)) * (9_000_000 // 256 + 1)
    for k, algorithm in enumerate(("sha1", "sha256", "md5")):
        piece = data[k * 3_000_000 : (k + 1) * 3_000_000]
        digest = base64.b64encode(hashlib.new(algorithm, piece).digest()).decode()
        wrong = patch(client, at, piece[:-1] + b"\0", k * 3_000_000, **{"Upload-Checksum": f"{algorithm} {digest}"})
        assert (wrong.status_code, wrong.json()["code"]) == (460, "checksum_mismatch")
        assert offset_of(client, at) == k * 3_000_000
        right = patch(client, at, iter([piece]), k * 3_000_000, **{"Upload-Checksum": f"{algorithm} {digest}"})
        assert right.status_code == 204
    assert result(client, at)["file"]["sha256"] == hashlib.sha256(data[:9_000_000]).hexdigest()
    at = created(client, acquisition, "white", 6_000_000, "x.raw")  # more than is kept in memory, in one piece
    digest = base64.b64encode(hashlib.sha256(data[:6_000_000]).digest()).decode()
    assert patch(client, at, data[:6_000_000], 0, **{"Upload-Checksum": f"sha256 {digest}"}).status_code == 204
    assert result(client, at)["state"] == "finished"


@pytest.mark.parametrize("given", ["crc32 AAAAAA==", "sha512 AAAA", "sha256", "sha256 !", "sha256 AAAA", ""])
def test_a_checksum_that_is_none_is_refused_before_the_body(service: Running, given: str) -> None:
    client = service.client()
    at = created(client, new_acquisition(client), "photo", 100)
    answer = patch(client, at, b"x" * 10, 0, **{"Upload-Checksum": given})
    assert (answer.status_code, answer.json()["code"]) == (400, "checksum_invalid")
    assert "sha256" in answer.json()["advice"]
    assert offset_of(client, at) == 0


def test_ended_upload_is_gone(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    at = created(client, acquisition, "photo", 100)
    patch(client, at, b"x" * 10, 0)
    assert client.post(at, headers={**TUS, "X-HTTP-Method-Override": "DELETE"}).status_code == 204
    assert list((service.settings.scratch / "uploads").iterdir()) == []
    assert client.head(at, headers=TUS).status_code == 410
    gone = patch(client, at, b"x", 10)
    assert (gone.status_code, gone.json()["code"]) == (410, "upload_gone")
    assert gone.json()["details"] == {"state": "terminated"}
    assert result(client, at)["state"] == "terminated"
    done = created(client, acquisition, "photo", len(PHOTO))
    assert patch(client, done, PHOTO, 0).status_code == 204
    assert client.delete(done, headers=TUS).json()["code"] == "state_conflict"
    assert client.head("/v1/uploads/up_" + "0" * 26, headers=TUS).status_code == 404
    assert client.head("/v1/uploads/..%2f..%2fspecimap.db", headers=TUS).status_code == 404


def test_expired_uploads_are_swept(tmp_path: Path) -> None:
    with serving(tmp_path, upload_hours=1) as service:
        client = service.client()
        acquisition = new_acquisition(client)
        asked, swept, kept = (created(client, acquisition, "photo", 100) for _ in range(3))
        for at in (asked, swept, kept):
            patch(client, at, b"x" * 10, 0)
        folder = service.settings.scratch / "uploads"
        with service.database.session() as session:
            ids = [at.rsplit("/", 1)[1] for at in (asked, swept)]
            session.execute(sa.update(Upload).where(Upload.id.in_(ids)).values(expires_at=utc_now()))
        assert client.head(asked, headers=TUS).status_code == 410
        (folder / "up_stray").write_bytes(b"young")
        both = [threading.Thread(target=sweep, args=(service.app.state.uploads,)) for _ in range(2)]
        for thread in both:
            thread.start()
        for thread in both:
            thread.join()
        assert {p.name for p in folder.iterdir()} == {kept.rsplit("/", 1)[1], "up_stray"}
        assert patch(client, swept, b"x", 10).json()["details"] == {"state": "expired"}
        assert offset_of(client, kept) == 10
        entries = client.get("/v1/audit", params={"target": swept.rsplit("/", 1)[1]}).json()["items"]
        assert [entry["action"] for entry in entries] == ["upload.expire", "upload.create"]


def test_limits_are_told_at_creation(tmp_path: Path) -> None:
    with serving(tmp_path, max_photo_bytes=1000, max_cube_bytes=5000, max_photos=2) as service:
        client = service.client(quota_bytes=6000)
        acquisition = new_acquisition(client)
        too_large = create(client, acquisition, "photo", 1001)
        assert (too_large.status_code, too_large.json()["code"]) == (413, "payload_too_large")
        assert too_large.json()["details"]["limit_bytes"] == 1000
        assert create(client, acquisition, "cube", 5001).json()["code"] == "payload_too_large"
        assert create(client, acquisition, "photo", 0).json()["code"] == "request_invalid"
        assert create(client, acquisition, "film", 10).json()["details"] == {"field": "role"}
        assert create(client, "acq_" + "0" * 26, "photo", 10).json()["code"] == "not_found"
        for _ in range(2):
            created(client, acquisition, "photo", 900)
        assert create(client, acquisition, "photo", 10).json()["code"] == "quota_exceeded"
        assert create(client, acquisition, "cube", 4300).json()["code"] == "quota_exceeded"
        assert create(client, acquisition, "cube", 4200).status_code == 201
        assert create(service.client(), acquisition, "white", 4300).status_code == 201


def test_reserve_of_the_disk_counts_what_is_still_to_come(tmp_path: Path) -> None:
    with serving(tmp_path, min_free_bytes=2**60) as service:
        client = service.client()
        full = create(client, new_acquisition(client), "photo", 10)
        assert (full.status_code, full.json()["code"]) == (507, "storage_full")
        assert full.json()["advice"]


def test_location_is_the_public_address(tmp_path: Path) -> None:
    with serving(tmp_path, public_url="https://specimap.example/base/") as service:
        client = service.client()
        forwarded = {"X-Forwarded-Host": "evil.example", "X-Forwarded-Proto": "ftp", "Host": "evil.example"}
        answer = create(client, new_acquisition(client), "photo", 10, **forwarded)
        assert answer.headers["Location"].startswith("https://specimap.example/base/v1/uploads/up_")


@pytest.mark.parametrize("acquisition", ["SP-1", "acq_1", "acq_\0", "exp_" + "0" * 26, "acq_" + "0" * 26 + "\n"])
def test_acquisition_that_is_no_id_is_refused(service: Running, acquisition: str) -> None:
    answer = create(service.client(), acquisition, "photo", 10)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert answer.json()["details"]["field"] == "acquisition"


def test_names_stay_out_of_paths_and_logs(
    service: Running, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "../../etc/Müller \u202e\x00 geb. 1950.jpg"
    client = service.client()
    acquisition = new_acquisition(client)
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG))
    with caplog.at_level("DEBUG"):
        at = created(client, acquisition, "photo", len(PHOTO), name)
        offset_of(client, at)
        patch(client, at, PHOTO, 0)
        file = result(client, at)["file"]
    assert file["name"] == name.replace("\x00", "")
    logged = caplog.text + "".join(capsys.readouterr())
    assert "/v1/uploads" in logged
    assert "ller" not in logged
    paths = [str(p) for p in service.settings.data_dir.rglob("*")]
    assert not any("ller" in p or "etc" in p for p in paths)
    assert "ller" not in json.dumps(client.get("/v1/audit").json())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scan.h5", "scan.nc", "scan.npz", "scan.mat", "scan.tif"])
def test_cubes_of_every_format_arrive(service: Running, name: str, tmp_path: Path) -> None:
    """HDF5 asks for a lock, where the upload that is being finished has one."""
    path, cube, nm = tmp_path / name, random_values("u2"), np.linspace(400, 1000, 11)
    if name.endswith((".h5", ".nc")):
        with h5py.File(path, "w") as f:
            f["cube"], f["wavelength"] = cube, nm
    elif name.endswith(".npz"):
        np.savez(path, cube=cube, wavelength=nm)
    elif name.endswith(".mat"):
        scipy_io.savemat(path, {"cube": cube, "wavelength": nm})
    else:
        tifffile.imwrite(path, cube.transpose(2, 0, 1), photometric="minisblack", compression="zstd")
    client = service.client()
    data = path.read_bytes()
    at = created(client, new_acquisition(client), "cube", len(data), name)
    assert patch(client, at, data, 0).headers["Specimap-Verdict"] == "accepted", result(client, at)


def test_second_cube_is_refused_before_and_after_it_is_sent(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    header = (SAMPLES / "hsi" / "hsi.hdr").read_bytes()
    first, second = (created(client, acquisition, "cube", len(header), "hsi.hdr") for _ in range(2))
    assert patch(client, first, header, 0).headers["Specimap-Verdict"] == "accepted"
    late = patch(client, second, header, 0)
    assert (late.status_code, late.headers["Specimap-Verdict"]) == (204, "refused")
    described = result(client, second)
    assert (described["state"], described["file"], described["error"]["code"]) == ("failed", None, "state_conflict")
    assert "Delete cube.hdr" in described["error"]["advice"]
    data = (SAMPLES / "hsi" / "hsi.raw").read_bytes()
    at = created(client, acquisition, "cube", len(data), "hsi.raw")
    assert patch(client, at, data, 0).headers["Specimap-Verdict"] == "accepted"
    assert create(client, acquisition, "cube", 10).json()["code"] == "state_conflict"

"""Acquisitions: made, found, read, deleted with all that hangs on them; their files listed, read and deleted."""

from __future__ import annotations

import datetime
import hashlib
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import Acquisition, Base, CloudRow, Job, JobEvent
from tests.support.places import SAMPLES
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import created, new_acquisition, patch, photos, send, sent

Parts = list[tuple[str, tuple[str | None, bytes | str]]]
PHOTO = photos()[0].read_bytes()
HEADER = (SAMPLES / "hsi" / "hsi.hdr").read_bytes()


def add_job(service: Running, acquisition: str, state: str) -> str:
    with service.database.session() as session:
        job = Job(
            id=new_id("job"),
            acquisition_id=acquisition,
            settings={},
            priority=5,
            state=state,
            request_hash="x",
            correlation_id="x",
            created_by="x",
        )
        session.add(job)
        session.flush()
        session.add(JobEvent(job_id=job.id, seq=1, type="state", data={}))
    return job.id


def test_made_and_read(service: Running) -> None:
    client = service.client()
    given = {"specimen_id": "SP-2026_0117.a", "accession_number": "A1", "edge_mm": 5.5, "dictionary": "DICT_5X5_100"}
    answer = client.post("/v1/acquisitions", json={**given, "notes": "left margin"})
    assert answer.status_code == 201
    made = answer.json()
    assert made.items() >= given.items()
    assert made["files"] == {"photos": 0, "refused": 0, "cube": False, "white": False, "dark": False}
    assert (made["ready"], len(made["missing"])) == (False, 2)
    assert client.get(f"/v1/acquisitions/{made['id']}").json() == made
    audited = client.get("/v1/audit", params={"target": made["id"]}).json()["items"]
    assert [(entry["action"], entry["key_id"]) for entry in audited] == [("acquisition.create", made["created_by"])]
    reader = service.client(["read"])
    assert reader.post("/v1/acquisitions", json=given).json()["code"] == "forbidden"
    assert reader.get(f"/v1/acquisitions/{made['id']}").status_code == 200
    assert service.client(["upload"]).get(f"/v1/acquisitions/{made['id']}").json()["code"] == "forbidden"
    assert client.get("/v1/acquisitions/acq_" + "0" * 26).json()["code"] == "not_found"
    assert client.get("/v1/acquisitions/etc").json()["code"] == "request_invalid"


def test_an_edge_that_no_job_takes_is_refused_and_one_stored_earlier_is_still_read(service: Running) -> None:
    client = service.client()
    for edge in (0.3, 250):
        refused = client.post("/v1/acquisitions", json={"specimen_id": "a", "edge_mm": edge})
        assert (refused.status_code, refused.json()["code"]) == (422, "request_invalid")
    made = new_acquisition(client)
    with service.database.session() as session:
        session.get_one(Acquisition, made).edge_mm = 250.0
    assert client.get(f"/v1/acquisitions/{made}").json()["edge_mm"] == 250.0
    assert [one["edge_mm"] for one in client.get("/v1/acquisitions").json()["items"]] == [250.0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"specimen_id": ""},
        {"specimen_id": "Jane Doe"},
        {"specimen_id": "x" * 65},
        {"specimen_id": "a\n"},
        {"specimen_id": "a", "edge_mm": 0},
        {"specimen_id": "a", "dictionary": "DICT_4X4_51"},
        {"specimen_id": "a", "edge_mm": 1e9},
        {"specimen_id": "a", "patient": "Doe"},
        {"specimen_id": "a", "accession_number": "a/b"},
        {"specimen_id": "a", "notes": "\0"},
    ],
)
def test_wrong_fields_are_refused(service: Running, wrong: dict[str, object]) -> None:
    answer = service.client().post("/v1/acquisitions", json=wrong)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")


def test_found_by_pseudonym_and_time_in_pages(service: Running) -> None:
    client = service.client()
    ids = [new_acquisition(client, specimen_id=f"S{k % 2}", accession_number=f"A{k}") for k in range(5)]
    listed = client.get("/v1/acquisitions", params={"specimen_id": "S0"}).json()
    assert [a["id"] for a in listed["items"]] == [ids[4], ids[2], ids[0]]
    assert [a["id"] for a in client.get("/v1/acquisitions?accession_number=A3").json()["items"]] == [ids[3]]
    walked, after = [], None
    while True:
        page = client.get("/v1/acquisitions", params={"limit": 2, **({"after": after} if after else {})}).json()
        walked += [a["id"] for a in page["items"]]
        after = page["next"]
        if after is None:
            break
    assert walked == ids[::-1]
    made_at = client.get(f"/v1/acquisitions/{ids[2]}").json()["created_at"]
    later = client.get("/v1/acquisitions", params={"created_after": made_at}).json()["items"]
    earlier = client.get("/v1/acquisitions", params={"created_before": made_at}).json()["items"]
    assert {a["id"] for a in later} == set(ids[2:])
    assert {a["id"] for a in earlier} == set(ids[:2])
    assert client.get("/v1/acquisitions?created_after=yesterday").json()["code"] == "request_invalid"


def test_files_are_listed_read_and_deleted(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    made = [sent(client, acquisition, "photo", f"IMG {path.stem}.png", path.read_bytes()) for path in photos()[:3]]
    assert [f["label"] for f in made] == ["photo-0001.jpg", "photo-0002.jpg", "photo-0003.jpg"]
    listed = client.get(f"/v1/acquisitions/{acquisition}/files").json()
    assert listed == made
    at = f"/v1/acquisitions/{acquisition}/files/{made[1]['id']}"
    assert client.get(at).json() == made[1]
    data = photos()[1].read_bytes()
    assert made[1]["sha256"] == hashlib.sha256(data).hexdigest()
    whole = client.get(f"{at}/content")
    assert (whole.content, whole.headers["content-type"]) == (data, "image/jpeg")
    part = client.get(f"{at}/content", headers={"Range": "bytes=-100"})
    assert (part.status_code, part.content) == (206, data[-100:])
    assert client.get(f"{at}/content", headers={"If-None-Match": whole.headers["etag"]}).status_code == 304
    reader = service.client(["read"])
    assert reader.get(f"{at}/content").status_code == 200
    assert reader.delete(at).status_code == 403
    elsewhere = new_acquisition(client)
    assert client.get(f"/v1/acquisitions/{elsewhere}/files/{made[1]['id']}").json()["code"] == "not_found"
    job = add_job(service, acquisition, "queued")
    busy = client.delete(at)
    assert (busy.status_code, busy.json()["details"]) == (409, {"job_id": job})
    with service.database.session() as session:
        session.execute(sa.update(Job).values(state="cancelled"))
    assert client.delete(at).status_code == 204
    assert client.get(f"{at}/content").json()["code"] == "not_found"
    kept = {item.key.rsplit("/", 1)[1] for item in service.storage.list(f"acquisitions/{acquisition}")}
    assert kept == {made[0]["id"], made[2]["id"]}
    again = sent(client, acquisition, "photo", "x.jpg", photos()[4].read_bytes())
    assert again["label"] == "photo-0004.jpg"


def test_deleted_with_everything(service: Running) -> None:
    admin, uploader = service.client(), service.client(["upload", "read"])
    acquisition, other = new_acquisition(uploader), new_acquisition(uploader)
    sent(uploader, acquisition, "photo", "x.jpg", PHOTO)
    sent(uploader, other, "photo", "x.jpg", PHOTO)
    at = created(uploader, acquisition, "cube", 1000)
    patch(uploader, at, b"x" * 10, 0)
    job = add_job(service, acquisition, "running")
    prefix = f"jobs/{job}/register/att_1"
    with service.database.session() as session:
        session.add(
            CloudRow(
                id=new_id("cloud"),
                job_id=job,
                acquisition_id=acquisition,
                prefix=prefix,
                points=1,
                bands=1,
                size=1,
                report={},
                created_at=utc_now(),
            )
        )
    service.storage.put(f"{prefix}/report.json", b"{}")
    service.storage.put(f"jobs/{job}/adjust/x", b"{}")
    address = f"/v1/acquisitions/{acquisition}"
    assert uploader.delete(address).json()["code"] == "forbidden"
    assert admin.delete(address).json()["details"] == {"job_id": job}
    with service.database.session() as session:
        session.execute(sa.update(Job).values(state="succeeded"))
    assert admin.delete(address).status_code == 204
    assert admin.delete(address).json()["code"] == "not_found"
    assert admin.get(f"{address}/files").json()["code"] == "not_found"
    with service.database.session() as session:
        # The audit trail outlives what it tells of.
        for table in (table for table in Base.metadata.sorted_tables if table.name != "audit"):
            if "acquisition_id" in table.c or table.name == "job_events":
                column = table.c["acquisition_id" if "acquisition_id" in table.c else "job_id"]
                assert acquisition not in session.scalars(sa.select(column)).all()
                assert job not in session.scalars(sa.select(column)).all()
    assert [item.key.split("/")[1] for item in service.storage.list("acquisitions")] == [other]
    assert list(service.storage.list("jobs")) == []
    assert list((service.settings.scratch / "uploads").iterdir()) == []
    (entry, *_) = admin.get("/v1/audit", params={"target": acquisition}).json()["items"]
    assert (entry["action"], entry["details"]) == ("acquisition.delete", {"jobs": [job]})


# ---- forms --------------------------------------------------------------------------------------------


def test_several_files_of_several_roles_in_one_form(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    digest = hashlib.sha256(PHOTO).hexdigest()
    parts: Parts = [
        ("role", (None, "photo")),
        ("sha256", (None, digest.upper())),
        ("file", ("ä b.jpg", PHOTO)),
        ("file", ("2.jpg", photos()[1].read_bytes())),
        ("role", (None, "cube")),
        ("file", ("h.hdr", HEADER)),
        ("file", ("h.raw", (SAMPLES / "hsi" / "hsi.raw").read_bytes())),
    ]
    answer = client.post(f"/v1/acquisitions/{acquisition}/files", files=parts)
    assert answer.status_code == 201, answer.text
    assert [f["label"] for f in answer.json()] == ["photo-0001.jpg", "photo-0002.jpg", "cube.hdr", "cube.raw"]
    assert answer.json()[0]["name"] == "ä b.jpg"
    assert answer.json()[3]["judgement"]["quantity"] == "reflectance"
    wrong: Parts = [("role", (None, "photo")), ("sha256", (None, "0" * 64)), ("file", ("x.jpg", PHOTO))]
    refused = client.post(f"/v1/acquisitions/{acquisition}/files", files=wrong)
    assert (refused.status_code, refused.json()["code"]) == (460, "checksum_mismatch")
    assert list((service.settings.scratch / "uploads").iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"--b--\r\n",
        b"--b\r\n",
        b"no form at all",
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="x"\r\n\r\nabc\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="role"\r\n\r\nking\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="role"\r\n\r\n' + b"x" * 9999 + b"\r\n--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="role"\r\n\r\nphoto\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="other"\r\n\r\nphoto\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="role"\r\n\r\nphoto\r\n'
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="x"\r\n\r\ncut sho',
        b'--b\r\nContent-Disposition: form-data; name="role"\r\n\r\nphoto\r\n'
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="x"\r\n\r\n\r\n--b--\r\n',
    ],
)
def test_forms_that_are_none(service: Running, body: bytes) -> None:
    client = service.client()
    at = f"/v1/acquisitions/{new_acquisition(client)}/files"
    answer = client.post(at, content=body, headers={"Content-Type": "multipart/form-data; boundary=b"})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert client.post(at, json={}).json()["code"] == "request_invalid"
    assert client.get(at).json() == []
    assert list((service.settings.scratch / "uploads").iterdir()) == []


@pytest.mark.slow
def test_forms_within_limits(tmp_path: Path) -> None:
    limits: dict[str, Any] = {"max_photo_bytes": 200_000, "max_cube_bytes": 500_000, "max_photos": 2}
    with serving(tmp_path, **limits) as service:
        client = service.client(quota_bytes=600_000)
        acquisition = new_acquisition(client)
        at = f"/v1/acquisitions/{acquisition}/files"
        large = send(client, acquisition, "photo", "x.jpg", b"x" * 200_001)
        assert (large.status_code, large.json()["code"]) == (413, "payload_too_large")
        known = client.post(at, content=b"", headers={"Content-Type": "multipart/form-data; boundary=b"})
        assert known.status_code == 422
        three: Parts = [("role", (None, "photo")), *(("file", (p.name, p.read_bytes())) for p in photos()[:3])]
        assert client.post(at, files=three).json()["code"] == "quota_exceeded"
        assert client.get(at).json() == []
        assert client.post(at, files=three[:3]).status_code == 201
        assert send(client, acquisition, "photo", "x.jpg", photos()[5].read_bytes()).json()["code"] == "quota_exceeded"
        assert send(client, acquisition, "cube", "x.raw", b"x" * 450_000).json()["code"] == "quota_exceeded"
        assert (
            service.client()
            .post(at, content=iter([b"x" * 1000]), headers={"Content-Type": "multipart/form-data; boundary=b"})
            .json()["code"]
            == "request_invalid"
        )
        stranger = service.client(["read"])
        assert send(stranger, acquisition, "photo", "x.jpg", PHOTO).json()["code"] == "forbidden"
    with serving(tmp_path / "full", min_free_bytes=2**60) as service:
        client = service.client()
        assert send(client, new_acquisition(client), "photo", "x.jpg", PHOTO).json()["code"] == "storage_full"


def test_times_are_utc(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    made = datetime.datetime.fromisoformat(client.get(f"/v1/acquisitions/{acquisition}").json()["created_at"])
    assert abs((datetime.datetime.now(datetime.UTC) - made).total_seconds()) < 60

"""The outbox against a real archive: STOW-RS, C-STORE, commitment, outages, and what is refused."""

from __future__ import annotations

import datetime
import io
import shutil
import socket
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.outbox.rows import Claim, request_set
from specimap_hospital.outbox.sender import Sender
from specimap_hospital.outbox.workspaces import sweep, workspace
from specimap_infra.database import Database, utc_now
from specimap_infra.settings import ServiceSettings
from specimap_infra.studies import put_study, study_keys
from specimap_infra.study_context import StudyContext
from specimap_infra.tables import AuditEntry, DicomInstance, DicomSet
from tests.support.hospital_scene import KEY, PATIENT, PLANTED, as_json
from tests.support.orthanc import RunningOrthanc, orthanc
from tests.support.outbox_scene import Clock, small_objects, waiting_cloud, with_settings
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving


def stow_settings(archive: RunningOrthanc) -> dict[str, Any]:
    return {"pacs_url": archive.dicomweb_url, "pacs_user": archive.user, "pacs_password": archive.password}


def dimse_settings(archive: RunningOrthanc) -> dict[str, Any]:
    return {"pacs_host": "127.0.0.1", "pacs_port": archive.dicom_port, "pacs_ae_title": archive.aet}


def sender_of(running: Running, clock: Clock, make: Any = small_objects, **given: object) -> Sender:
    settings = with_settings(running.settings, **given)
    return Sender(running.database, running.storage, settings, make=make, clock=clock)


def states(database: Database) -> list[str]:
    with database.session() as session:
        return list(session.scalars(sa.select(DicomInstance.state).order_by(DicomInstance.id)))


def the_set(database: Database) -> DicomSet:
    with database.session() as session:
        return session.scalars(sa.select(DicomSet)).one()


@pytest.fixture
def hospital(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database, study_keys=[KEY]) as running:
        yield running


# ---- the ways to the archive --------------------------------------------------------------------------


@pytest.mark.parametrize("way", [stow_settings, dimse_settings])
def test_the_objects_of_a_result_arrive(
    archive: RunningOrthanc, tmp_path: Path, way: Callable[[RunningOrthanc], dict[str, Any]]
) -> None:
    with serving(tmp_path / "service", study_keys=[KEY], **way(archive)) as running:
        client = running.client()
        result = put_result(running, tmp_path / "result")
        clock = Clock()
        sender = Sender(running.database, running.storage, running.settings, clock=clock)
        sender.add()
        assert not sender.work(), "there is no study context yet"
        assert client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=as_json()).status_code == 200
        assert sender.add() == 1
        assert sender.add() == 0
        assert sender.work()
        assert not sender.work()
        (listed,) = client.get(f"/v1/clouds/{result.cloud_id}/dicom").json()
        assert (listed["state"], listed["reason"]) == ("sent", None), listed
        uids = {instance["sop_instance_uid"] for instance in listed["instances"]}
        assert uids
        assert {instance["state"] for instance in listed["instances"]} == {"sent"}
        assert uids <= archive.instances()
        found = archive.get("/patients?expand")
        assert PATIENT.patient_id in {patient["MainDicomTags"]["PatientID"] for patient in found}
        assert not any(text in str(listed) for text in PLANTED)
        assert not list(running.settings.scratch.glob("dicom-*")), "what holds patient data goes at once"
        with running.database.session() as session:
            entry = session.scalars(sa.select(AuditEntry).where(AuditEntry.action == "dicom.send")).one()
        assert entry.target == result.cloud_id
        assert entry.details["objects"] == {"sent": len(uids)}


def test_c_store_stands_in_where_the_web_does_not_answer(archive: RunningOrthanc, hospital: Running) -> None:
    cloud = waiting_cloud(hospital)
    clock = Clock()
    sender = sender_of(hospital, clock, pacs_url="http://127.0.0.1:9/dicom-web", **dimse_settings(archive))
    sender.add()
    assert sender.work()
    assert states(hospital.database) == ["sent"] * 3
    assert the_set(hospital.database).cloud_id == cloud


def test_the_archive_commits_itself(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with (
        orthanc(tmp_path / "orthanc", peers={"SPECIMAP": port}) as archive,
        serving(
            tmp_path / "service",
            study_keys=[KEY],
            pacs_commitment="on",
            dicom_port=port,
            **stow_settings(archive),
            **dimse_settings(archive),
        ) as running,
    ):
        from specimap_hospital.receive.listener import start_listener

        waiting_cloud(running)
        clock = Clock()
        stop = start_listener(running.database, running.settings)
        try:
            sender = sender_of(running, clock)
            sender.add()
            assert sender.work()
            assert states(running.database) == ["sent"] * 3
            gone = sorted(archive.get("/instances"))[0]
            httpx.delete(f"{archive.url}/instances/{gone}", auth=archive.auth, trust_env=False).raise_for_status()
            assert sender.work(), "the archive is asked for its commitment"
            wait_for(lambda: the_set(running.database).state == "waiting")
            assert sorted(states(running.database)) == ["committed", "committed", "waiting"]
            clock.now = utc_now()
            assert sender.work(), "what it lacks is sent again"
            assert sender.work()
            wait_for(lambda: the_set(running.database).state == "committed")
            assert states(running.database) == ["committed"] * 3
            assert not sender.work()
        finally:
            stop()


def wait_for(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    import time

    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.05)


# ---- outages and refusals -----------------------------------------------------------------------------


def test_an_archive_that_is_away_is_tried_at_growing_intervals_and_given_up(hospital: Running) -> None:
    waiting_cloud(hospital)
    clock = Clock()
    sender = sender_of(hospital, clock, pacs_url="http://127.0.0.1:9/dicom-web", pacs_attempts=12)
    sender.add()
    waits = []
    while the_set(hospital.database).state == "waiting":
        before = clock()
        assert sender.work()
        assert not sender.work(), "it is not due yet"
        clock.now = max(clock.now, the_set(hospital.database).next_at)
        waits.append((clock() - before).total_seconds())
    assert waits[:9] == [5, 10, 20, 40, 80, 160, 320, 640, 900]
    row = the_set(hospital.database)
    assert (row.state, row.reason, len(waits)) == ("failed", "not_reachable", 12)
    cloud = row.cloud_id
    with hospital.database.session() as session:
        request_set(session, cloud, {}, "key_test", clock(), again=False)
    assert (the_set(hospital.database).state, the_set(hospital.database).attempts) == ("waiting", 0)


def test_what_the_archive_refuses_does_not_keep_the_others_from_it(archive: RunningOrthanc, hospital: Running) -> None:
    waiting_cloud(hospital)

    def make(held: Claim, folder: Path, cancelled: Callable[[], bool]) -> list[DicomObject]:
        objects = small_objects(held, folder, cancelled)
        from pydicom import dcmread

        broken = dcmread(objects[1].path)
        broken.PatientID = broken.StudyInstanceUID = broken.SeriesInstanceUID = ""
        broken.save_as(objects[1].path)
        return objects

    sender = sender_of(hospital, Clock(), make, **stow_settings(archive))
    sender.add()
    assert sender.work()
    row = the_set(hospital.database)
    assert (row.state, row.reason) == ("failed", "refused")
    assert sorted(states(hospital.database)) == ["failed", "sent", "sent"]
    with hospital.database.session() as session:
        (reason,) = session.scalars(sa.select(DicomInstance.reason).where(DicomInstance.state == "failed"))
    assert reason


def test_a_sender_asks_for_what_another_may_have_sent(archive: RunningOrthanc, hospital: Running) -> None:
    waiting_cloud(hospital)
    clock = Clock()
    sender = sender_of(hospital, clock, **stow_settings(archive))
    sender.add()
    assert sender.work()
    before = archive.get("/changes?last")["Last"]
    with hospital.database.session() as session:
        # As one leaves it that was killed after the archive had taken it.
        session.execute(sa.update(DicomInstance).values(state="waiting"))
        session.execute(sa.update(DicomSet).values(state="waiting", next_at=clock()))
    assert sender.work()
    assert states(hospital.database) == ["sent"] * 3
    assert archive.get("/changes?last")["Last"] == before, "nothing arrived a second time"


def test_a_corrected_study_context_is_sent_over_the_first(archive: RunningOrthanc, hospital: Running) -> None:
    cloud = waiting_cloud(hospital)
    clock = Clock()
    sender = sender_of(hospital, clock, **stow_settings(archive))
    sender.add()
    assert sender.work()
    before = archive.get("/changes?last")["Last"]
    keys = study_keys(hospital.settings)
    with hospital.database.session() as session:
        row = session.scalars(sa.select(DicomSet)).one()
        from specimap_infra.tables import CloudRow

        acquisition = session.get_one(CloudRow, row.cloud_id).acquisition_id
        put_study(session, keys, acquisition, StudyContext(patient_id="CORRECTED"), "key_test")
    assert sender.add() == 1
    assert states(hospital.database) == ["waiting"] * 3
    assert sender.work()
    assert archive.get("/changes?last")["Last"] > before
    assert (the_set(hospital.database).study_version, the_set(hospital.database).cloud_id) == (2, cloud)
    assert states(hospital.database) == ["sent"] * 3


def test_two_senders_do_not_take_the_same_set(hospital: Running) -> None:
    from specimap_hospital.outbox.rows import claim, finish, renew

    waiting_cloud(hospital)
    clock = Clock()
    sender_of(hospital, clock, pacs_url="http://127.0.0.1:9").add()
    lease = datetime.timedelta(seconds=120)
    first = claim(hospital.database, "one", clock(), lease, ("waiting",))
    assert first is not None
    assert claim(hospital.database, "two", clock(), lease, ("waiting",)) is None
    clock.advance(100)
    assert renew(hospital.database, first, clock() + lease)
    clock.advance(100)
    assert claim(hospital.database, "two", clock(), lease, ("waiting",)) is None
    clock.advance(21)
    second = claim(hospital.database, "two", clock(), lease, ("waiting",))
    assert second is not None
    assert not renew(hospital.database, first, clock() + lease)
    assert not finish(hospital.database, first, clock(), state="sent")
    assert the_set(hospital.database).state == "waiting"
    assert finish(hospital.database, second, clock(), state="sent")


def test_a_set_is_sent_by_request_alone_where_the_settings_say_so(hospital: Running) -> None:
    cloud = waiting_cloud(hospital)
    sender = sender_of(hospital, Clock(), pacs_url="http://127.0.0.1:9", pacs_send="requested")
    assert sender.add() == 0
    with hospital.database.session() as session:
        request_set(session, cloud, {}, "key_test", utc_now(), again=False)
    assert the_set(hospital.database).state == "waiting"


# ---- the API ------------------------------------------------------------------------------------------


def test_objects_are_asked_for_by_the_api(tmp_path: Path) -> None:
    with serving(tmp_path / "service", study_keys=[KEY], pacs_url="http://127.0.0.1:9") as running:
        client = running.client()
        result = put_result(running, tmp_path / "result")
        path = f"/v1/clouds/{result.cloud_id}/dicom"
        refused = client.post(path, json={})
        assert (refused.status_code, refused.json()["code"]) == (409, "study_missing")
        client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=as_json())
        first = client.post(path, json={})
        assert first.status_code == 202
        assert client.post(path, json={}).json()["id"] == first.json()["id"]
        bands = client.post(path, json={"bands": [1, 2]}).json()
        assert bands["objects"] == {"bands": [1, 2]}
        assert client.post(path, json={"bands": [1], "label": "tissue"}).status_code == 422
        assert [row["id"] for row in client.get(path).json()] == [first.json()["id"], bands["id"]]
        page = client.get(path, params={"limit": 1})
        assert len(page.json()) == 1
        assert "after=" in page.headers["link"]


def test_without_an_archive_the_api_says_so(hospital: Running, tmp_path: Path) -> None:
    result = put_result(hospital, tmp_path / "result")
    answer = hospital.client().post(f"/v1/clouds/{result.cloud_id}/dicom", json={})
    assert (answer.status_code, answer.json()["code"]) == (409, "archive_missing")


# ---- folders ------------------------------------------------------------------------------------------


def test_folders_of_killed_senders_are_removed_and_no_other(tmp_path: Path) -> None:
    with workspace(tmp_path) as held:
        (held / "object").write_bytes(b"x")
        left = tmp_path / f"dicom-{'0' * 32}.tmp"
        left.mkdir()
        (left / "lock").touch()
        assert sweep(tmp_path) == 1
        assert not left.exists()
        assert (held / "object").exists()
    assert not held.exists()
    shutil.rmtree(tmp_path)


def test_settings_say_whether_there_is_work(tmp_path: Path) -> None:
    def has(**given: object) -> bool:
        settings: ServiceSettings = with_settings(None, data_dir=tmp_path, **given)
        return settings.has_hospital_process

    assert not has()
    assert has(pacs_url="https://pacs.example/dicom-web")
    assert has(pacs_host="pacs.example", pacs_ae_title="PACS")
    assert has(dicom_port=11112)


# ---- the ZIP ------------------------------------------------------------------------------------------


def test_the_first_set_comes_as_a_zip_and_leaves_nothing(tmp_path: Path) -> None:
    with serving(tmp_path / "service", study_keys=[KEY]) as running:
        client = running.client()
        result = put_result(running, tmp_path / "result")
        path = f"/v1/clouds/{result.cloud_id}/dicom.zip"
        missing = client.get(path)
        assert (missing.status_code, missing.json()["code"]) == (409, "study_missing")
        client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=as_json())
        answer = client.get(path)
        assert answer.status_code == 200
        assert answer.headers["cache-control"] == "no-store"
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            names = archive.namelist()
            assert archive.testzip() is None
        assert any(name.endswith("DICOMDIR") for name in names)
        assert len(names) > 4
        assert not any(text in name for text in PLANTED for name in names)
        assert not list(running.settings.scratch.glob("dicom-*"))
        assert client.head(path).status_code in (200, 405)
        assert running.client(["read"]).get(path).status_code == 403

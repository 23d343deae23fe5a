"""Study contexts: encrypted, bound to their acquisition, readable after a rotation, and nowhere in clear."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from contextlib import redirect_stderr
from pathlib import Path

import pytest
import sqlalchemy as sa
from typer.testing import CliRunner

from specimap_cli.app import app
from specimap_core.errors import SettingsError
from specimap_hospital.fhir.notices import add_notices
from specimap_hospital.outbox.rows import add_wanted
from specimap_infra.backup import create_backup
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import StudySealedError
from specimap_infra.settings import load_settings
from specimap_infra.studies import find_study, put_study, rotate, study_keys
from specimap_infra.study_context import StudyContext
from specimap_infra.study_keys import StudyKeys, new_key
from specimap_infra.tables import CloudRow, SealedStudy
from tests.support.hospital_scene import KEY, PATIENT, PLANTED, as_json
from tests.support.job_scene import acquisition
from tests.support.outbox_scene import waiting_cloud
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition


@pytest.fixture
def hospital(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database, study_keys=[KEY]) as running:
        yield running


def path_of(acquisition_id: str) -> str:
    return f"/v1/acquisitions/{acquisition_id}/study"


def test_a_study_context_is_kept_changed_read_and_removed(hospital: Running) -> None:
    client = hospital.client(["upload"])
    path = path_of(new_acquisition(client))
    assert client.get(path).status_code == 404
    put = client.put(path, json=as_json())
    assert put.status_code == 200, put.text
    assert (put.json()["version"], put.headers["cache-control"]) == (1, "no-store")
    read = client.get(path).json()
    assert StudyContext.model_validate(read["study"]) == PATIENT
    assert client.put(path, json=as_json()).json()["version"] == 1
    other = PATIENT.model_copy(update={"patient_id": "OTHER"})
    assert client.put(path, json=as_json(other)).json()["version"] == 2
    assert client.get(path).json()["study"]["patient_id"] == "OTHER"
    assert client.delete(path).status_code == 204
    assert client.get(path).status_code == 404
    assert client.delete(path).status_code == 404


def test_one_that_was_removed_and_entered_again_is_sent_and_told_anew(hospital: Running) -> None:
    cloud_id = waiting_cloud(hospital)
    database, keys = hospital.database, study_keys(hospital.settings)
    assert add_wanted(database, utc_now(), automatic=True) == 1
    assert add_notices(database, utc_now(), archived=False) == 1
    with database.session() as session:
        acquisition_id = session.get_one(CloudRow, cloud_id).acquisition_id
        session.delete(session.get_one(SealedStudy, acquisition_id))
    with database.session() as session:
        put_study(session, keys, acquisition_id, PATIENT.model_copy(update={"patient_id": "OTHER"}), "key_test")
    assert add_wanted(database, utc_now(), automatic=True) == 1
    assert add_notices(database, utc_now(), archived=False) == 1


def test_a_hold_keeps_it(hospital: Running) -> None:
    client = hospital.client()
    acquisition_id = new_acquisition(client)
    path = path_of(acquisition_id)
    assert client.put(path, json=as_json()).status_code == 200
    assert client.put(f"/v1/acquisitions/{acquisition_id}/hold", json={"reason": "lawsuit-7"}).status_code == 201
    other = as_json(PATIENT.model_copy(update={"patient_id": "OTHER"}))
    for answer in (client.delete(path), client.put(path, json=other)):
        assert (answer.status_code, answer.json()["code"]) == (409, "legal_hold")
    assert client.put(path, json=as_json()).status_code == 200
    assert client.delete(f"/v1/acquisitions/{acquisition_id}/hold").status_code == 204
    assert client.delete(path).status_code == 204


def test_it_goes_with_its_acquisition(hospital: Running) -> None:
    client = hospital.client()
    acquisition_id = new_acquisition(client)
    assert client.put(path_of(acquisition_id), json=as_json()).status_code == 200
    assert client.delete(f"/v1/acquisitions/{acquisition_id}").status_code == 204
    with hospital.database.session() as session:
        assert session.scalar(sa.select(sa.func.count()).select_from(SealedStudy)) == 0


def test_who_may_only_read_results_does_not_see_whose_they_are(hospital: Running) -> None:
    path = path_of(new_acquisition(hospital.client(["upload"])))
    assert hospital.client(["upload"]).put(path, json=as_json()).status_code == 200
    for scope in ("read", "label", "intraoperative"):
        for method in ("GET", "PUT", "DELETE"):
            answer = hospital.client([scope]).request(method, path, json=as_json() if method == "PUT" else None)
            assert answer.status_code == 403
            assert not any(text in answer.text for text in PLANTED)
    assert hospital.client(["admin"]).get(path).status_code == 200


def test_without_a_key_nothing_is_kept(tmp_path: Path) -> None:
    with serving(tmp_path / "service") as running:
        client = running.client()
        path = path_of(new_acquisition(client))
        for answer in (client.put(path, json=as_json()), client.get(path)):
            assert (answer.status_code, answer.json()["code"]) == (503, "study_keys_missing")
            assert "SPECIMAP_STUDY_KEYS" in answer.json()["advice"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"patient_id": "Quasimodo" * 20},
        {"patient_name": "Doe\nQuasimodo"},
        {"patient_birth_date": "Quasimodo"},
        {"patient_sex": "Quasimodo"},
        {"study_instance_uid": "Quasimodo"},
        {"study_time": "Quasimodo"},
        {"Quasimodo": 1},
        {"accession_number": {"Quasimodo": 1}},
        ["Quasimodo"],
        "Quasimodo",
    ],
)
def test_a_refusal_does_not_repeat_what_was_sent(hospital: Running, wrong: object) -> None:
    client = hospital.client()
    answer = client.put(path_of(new_acquisition(client)), json=wrong)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert "Quasimodo" not in answer.text
    broken = client.put(
        path_of(new_acquisition(client)),
        content=b'{"patient_name": "Quasimodo',
        headers={"Content-Type": "application/json"},
    )
    assert broken.status_code == 422
    assert "Quasimodo" not in broken.text


# ---- encryption ---------------------------------------------------------------------------------------


def test_rows_cannot_be_changed_or_swapped(tables: Database) -> None:
    keys = StudyKeys.of([new_key()])
    first, second = acquisition(tables), acquisition(tables)
    with tables.session() as session:
        for owner, name in ((first, "Doe^Jane"), (second, "Doe^John")):
            put_study(session, keys, owner, StudyContext(patient_name=name), "key_test")
    with tables.session() as session:
        one, two = session.get_one(SealedStudy, first), session.get_one(SealedStudy, second)
        one.sealed, two.sealed = two.sealed, one.sealed
    for owner in (first, second):
        with tables.session() as session, pytest.raises(StudySealedError):
            find_study(session, keys, owner)
    with tables.session() as session:
        row = session.get_one(SealedStudy, first)
        row.sealed = row.sealed[:-8] + "AAAAAAA="
    with tables.session() as session, pytest.raises(StudySealedError) as caught:
        find_study(session, keys, first)
    assert "Doe" not in str(caught.value.as_dict())


def test_after_a_rotation_the_old_key_can_go(tables: Database) -> None:
    old, new = new_key(), new_key()
    owners = [acquisition(tables, photos=0) for _ in range(5)]
    with tables.session() as session:
        for owner in owners:
            put_study(session, StudyKeys.of([old]), owner, PATIENT, "key_test")
    with tables.session() as session, pytest.raises(StudySealedError) as caught:
        find_study(session, StudyKeys.of([new]), owners[0])
    assert caught.value.details["key_id"] == StudyKeys.of([old]).newest
    assert rotate(tables, StudyKeys.of([new])) == (0, 5)
    assert rotate(tables, StudyKeys.of([new, old])) == (5, 0)
    assert rotate(tables, StudyKeys.of([new, old])) == (0, 0)
    for owner in owners:
        with tables.session() as session:
            found = find_study(session, StudyKeys.of([new]), owner)
        assert found is not None
        assert (found.context, found.row.version) == (PATIENT, 1)


def test_keys_are_rotated_on_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = CliRunner().invoke(app, ["contexts", "new-key"])
    assert made.exit_code == 0
    with serving(tmp_path / "service", study_keys=[KEY]) as running:
        client = running.client()
        path = path_of(new_acquisition(client))
        assert client.put(path, json=as_json()).status_code == 200
        monkeypatch.setenv("SPECIMAP_DATA_DIR", str(tmp_path / "service"))
        monkeypatch.setenv("SPECIMAP_STUDY_KEYS", json.dumps([made.output.strip(), KEY]))
        done = CliRunner().invoke(app, ["contexts", "rotate"])
        assert (done.exit_code, done.output.split()[0]) == (0, "1"), done.output
    with serving(tmp_path / "service", study_keys=[made.output.strip()]) as running:
        assert StudyContext.model_validate(running.client().get(path).json()["study"]) == PATIENT


@pytest.mark.parametrize("keys", [["no base64!"], ["c2hvcnQ="], [KEY, KEY]])
def test_a_wrong_key_is_refused_without_repeating_it(tmp_path: Path, keys: list[str]) -> None:
    with pytest.raises(SettingsError) as caught:
        load_settings(data_dir=tmp_path, study_keys=keys)
    assert not any(key in str(caught.value.as_dict()) for key in keys)
    assert KEY not in repr(StudyKeys.of([KEY]))


# ---- where it must not be -----------------------------------------------------------------------------


def test_patient_data_stand_nowhere_in_clear(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    errors = io.StringIO()
    with serving(tmp_path / "service", study_keys=[KEY]) as running, redirect_stderr(errors):
        client = running.client()
        result = put_result(running, tmp_path / "result")
        path = path_of(result.acquisition_id)
        caplog.set_level(logging.DEBUG)
        assert client.put(path, json=as_json()).status_code == 200
        assert client.put(path, json=as_json() | {"patient_sex": "Quasimodo"}).status_code == 422
        assert client.get(path).status_code == 200
        shown = [
            client.get(address).text
            for address in (
                "/metrics",
                "/v1/audit",
                "/v1/acquisitions",
                f"/v1/jobs/{result.job_id}",
                f"/v1/jobs/{result.job_id}/log",
                f"/v1/clouds/{result.cloud_id}",
                f"/v1/clouds/{result.cloud_id}/dicom",
                f"/v1/clouds/{result.cloud_id}/zarr/zarr.json",
            )
        ]
        assert '"study.put"' in shown[1]
        create_backup(running.database, running.storage, tmp_path / "backup")
        # What the database has in its journal too.
        kept = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
        assert any(file.name == "specimap.db" for file in kept)
        for text in PLANTED:
            assert not any(text in page for page in shown), text
            assert text not in caplog.text + errors.getvalue(), text
            for file, content in kept.items():
                assert text.encode() not in content, f"{text} in {file}"
                assert text not in file.name

"""Erasure of a specimen: nothing of it is left anywhere, the certificate is genuine, the audit trail still verifies."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from specimap_core.errors import NotFoundError
from specimap_hospital.erasure import LIST, Eraser, erased_before, is_genuine
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.verification import verify
from specimap_infra.backup import create_backup
from specimap_infra.database import Database
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.ids import new_id
from specimap_infra.queue import EXPORTS, JOBS, MAKE_EXPORT, RUN_JOB, enqueue, queue_client
from specimap_infra.settings import load_settings
from specimap_infra.tables import Acquisition, Base, Erasure, Export, StoredFile, Upload
from tests.support.backup_scene import add_artefact, add_upload, specimap
from tests.support.label_files import NPY, layer, npy
from tests.support.planted import encodings
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving

SPECIMEN = "Zqx7Kw-SPECIMEN.0117"
NOTES = "Zqx7Kw-NOTES-Doe^Jane"
MARK = "Zqx7Kw"


def filled(service: Running, folder: Path, specimen: str) -> Result:
    """A specimen with everything that the service keeps of one, and a mark in each text that a client gave."""
    client = service.client()
    result = put_result(service, folder, specimen_id=specimen, accession_number=f"{MARK}-ACC")
    owner = result.acquisition_id
    service.storage.put(f"acquisitions/{owner}/file", f"{MARK} photo".encode())
    add_artefact(service.database, service.storage, owner)
    upload = add_upload(service.database, owner, "open")
    (service.settings.scratch / "uploads").mkdir(parents=True, exist_ok=True)
    (service.settings.scratch / "uploads" / upload).write_bytes(f"{MARK} upload".encode())
    queue = queue_client(service.database.engine)
    with service.database.session() as session:
        session.get_one(Acquisition, owner).notes = NOTES
        session.get_one(Upload, upload).name = f"{MARK}-upload.jpg"
        session.add(
            StoredFile(
                id=new_id("file"),
                acquisition_id=owner,
                role="photo",
                label="photo-0001.jpg",
                name=f"{MARK}-file.jpg",
                size=1,
                sha256="0",
                storage_key=f"acquisitions/{owner}/file",
                state="accepted",
                judgement={"reason": f"{MARK} is blurred"},
                created_by="key_test",
            )
        )
        export = new_id("exp")
        row = Export(
            id=export, cloud_id=result.cloud_id, format="ply", state="succeeded", correlation_id="", created_by="k"
        )
        row.storage_key = f"exports/{export}/a/cloud.ply"
        session.add(row)
        enqueue(queue, session, JOBS, RUN_JOB, result.job_id, 5)
        enqueue(queue, session, EXPORTS, MAKE_EXPORT, export, 5)
    service.storage.put(f"exports/{export}/a/cloud.ply", f"{MARK} export".encode())
    described = {
        "kind": "class",
        "classes": [{"value": 0, "name": f"{MARK} class"}],
        "made_by": {"name": f"{MARK} person", "version": "1"},
    }
    labelled = client.put(
        layer(result, f"{MARK.lower()}-layer"),
        content=npy(np.zeros(result.cloud.n_points, np.uint8)),
        headers={"X-Specimap-Label": json.dumps(described), "Content-Type": NPY},
    )
    assert labelled.status_code == 201, labelled.text
    expires = {"name": f"{MARK} board", "expires_at": "2026-12-20T00:00:00Z"}
    shared = client.post(
        f"/v1/clouds/{result.cloud_id}/shares", json=expires, headers={"Idempotency-Key": f"{MARK}-key"}
    )
    assert shared.status_code == 201, shared.text
    # Reads, which the audit trail tells of, and a refused one.
    assert client.get("/v1/acquisitions", params={"specimen_id": specimen}).json()["items"]
    client.get(f"/v1/clouds/{result.cloud_id}/labels/{MARK.lower()}-layer")
    client.get(f"/v1/clouds/{result.cloud_id}/labels/{MARK.lower()}-none")
    return result


def raw_files(service: Running) -> Iterator[tuple[str, bytes]]:
    """Every byte below the data folder: database, journal, storage, scratch, lists."""
    for path in service.settings.data_dir.rglob("*"):
        yield f"{path} (name)", str(path.relative_to(service.settings.data_dir)).encode()
        if path.is_file():
            yield str(path), path.read_bytes()


def found_in(service: Running, text: str) -> set[str]:
    forms = list(encodings(text).values())
    return {name for name, data in raw_files(service) if any(form in data for form in forms)}


def erase(client: httpx.Client, specimen: str = SPECIMEN) -> dict[str, Any]:
    answer = client.post("/v1/erasures", json={"specimen_id": specimen})
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    return made


def test_nothing_is_left_of_a_specimen(service: Running, tmp_path: Path) -> None:
    first = filled(service, tmp_path / "one", SPECIMEN)
    second = put_result(service, tmp_path / "two", specimen_id=SPECIMEN)
    other = put_result(service, tmp_path / "three", specimen_id="S-other")
    admin = service.client()
    assert found_in(service, SPECIMEN)
    assert found_in(service, MARK)
    made = erase(admin)
    certificate = made["certificate"]
    assert set(made["acquisitions"]) == {first.acquisition_id, second.acquisition_id}
    assert certificate["left"] == {"rows": 0, "files": 0, "scratch": 0}
    assert {
        name: certificate["rows"][name] for name in ("acquisitions", "jobs", "clouds", "labels", "shares", "exports")
    } == {
        "acquisitions": 2,
        "jobs": 2,
        "clouds": 2,
        "labels": 1,
        "shares": 1,
        "exports": 1,
    }
    assert certificate["rows"]["repeatable_requests"] == 1
    assert certificate["workflows"] == 3
    assert found_in(service, SPECIMEN) == set()
    assert found_in(service, MARK) == set()
    # Not only the texts: the ids stand in the audit trail and in the certificate alone.
    for name in (first.cloud_id, first.job_id):
        assert all(Path(place).name.startswith("specimap.db") for place in found_in(service, name))
    with service.database.session() as session:
        for table in Base.metadata.tables.values():
            if table.name not in ("audit", "erasures"):
                rows = [str(tuple(row)) for row in session.execute(sa.select(table))]
                assert not [row for row in rows if first.acquisition_id in row or first.job_id in row], table.name
        engine = [str(tuple(row)) for row in session.execute(sa.text("SELECT * FROM workflow_status"))]
        assert not [row for row in engine if first.job_id in row]
    # Others stay, and the trail verifies.
    assert admin.get(f"/v1/clouds/{other.cloud_id}").status_code == 200
    assert admin.get(f"/v1/clouds/{first.cloud_id}").status_code == 404
    service.app.state.context.trail.flush()
    assert verify(service.database, ChainKeys.of(service.settings)).fault is None
    listed = admin.get("/v1/audit", params={"acquisition": first.acquisition_id}).json()["items"]
    assert listed[0]["action"] == "acquisition.erase"
    assert (certificate["audit"]["seq"], certificate["audit"]["hash"]) in {(e["seq"], e["hash"]) for e in listed} | {
        (e["seq"], e["hash"])
        for e in admin.get("/v1/audit", params={"acquisition": second.acquisition_id}).json()["items"]
    }
    assert admin.get("/v1/erasures").json()["items"] == [made]
    again = admin.post("/v1/erasures", json={"specimen_id": SPECIMEN})
    assert again.status_code == 404


def test_a_certificate_is_genuine_and_a_changed_one_is_not(service: Running, tmp_path: Path) -> None:
    put_result(service, tmp_path / "one", specimen_id=SPECIMEN)
    certificate = erase(service.client())["certificate"]
    public = certificate["public_key"]
    assert is_genuine(certificate, public)
    assert not is_genuine({**certificate, "files": 0, "by": "x"}, public)
    assert not is_genuine(certificate, public[::-1])
    key = service.settings.data_dir / "signing-key.pem"
    assert key.stat().st_mode & 0o777 == 0o600
    file = tmp_path / "certificate.json"
    file.write_text(json.dumps(certificate))
    given = {"data_dir": service.settings.data_dir}
    assert specimap(given, "verify-certificate", str(file), "--public-key", public).returncode == 0
    file.write_text(json.dumps({**certificate, "files": 0}))
    assert specimap(given, "verify-certificate", str(file), "--public-key", public).returncode == 1


def test_a_running_job_refuses_and_a_stopped_erasure_goes_on(any_database: str, tmp_path: Path) -> None:
    with serving(tmp_path / "service", database_url=any_database) as service:
        result = put_result(service, tmp_path / "one", specimen_id=SPECIMEN, state="running")
        admin = service.client()
        refused = admin.post("/v1/erasures", json={"specimen_id": SPECIMEN})
        assert (refused.status_code, refused.json()["code"]) == (409, "state_conflict")
        with service.database.session() as session:
            session.execute(sa.text("UPDATE jobs SET state = 'failed'"))
        eraser = Eraser(service.database, service.storage, service.settings, queue_client(service.database.engine))
        away = StorageUnavailableError("away", advice="")
        with mock.patch.object(service.storage, "delete", side_effect=away), pytest.raises(StorageUnavailableError):
            eraser.erase(SPECIMEN, "key_1")
        assert list(service.storage.list(f"jobs/{result.job_id}"))
        assert erase(admin)["certificate"]["left"]["files"] == 0
        with service.database.session() as session:
            assert session.scalars(sa.select(Erasure.state)).all() == ["done"]
        with pytest.raises(NotFoundError):
            eraser.erase(SPECIMEN, "key_1")


def test_a_restore_erases_again_what_its_backup_brings_back(tmp_path: Path) -> None:
    with serving(tmp_path / "old") as service:
        first = put_result(service, tmp_path / "one", specimen_id=SPECIMEN)
        # Deleted before the erasure, but in the backup.
        second = put_result(service, tmp_path / "two", specimen_id=SPECIMEN)
        other = put_result(service, tmp_path / "three", specimen_id="S-other")
        create_backup(service.database, service.storage, tmp_path / "backup")
        admin = service.client()
        assert admin.delete(f"/v1/acquisitions/{second.acquisition_id}").status_code == 204
        erase(admin)
        kept = service.settings.data_dir
    new = tmp_path / "new"
    new.mkdir()
    for name in (LIST, "signing-key.pem"):
        (new / name).write_bytes((kept / name).read_bytes())
    assert SPECIMEN not in (new / LIST).read_text()
    done = specimap({"data_dir": new}, "restore", "--from", str(tmp_path / "backup"), "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {"event": "erased", "specimens": 1}
    database = Database.open(load_settings(data_dir=new).database)
    with database.session() as session:
        assert session.scalars(sa.select(Acquisition.id)).all() == [other.acquisition_id]
    assert verify(database, ChainKeys()).fault is None
    database.close()
    left = {path.name for path in (new / "storage" / "jobs").iterdir()}
    assert (first.job_id in left, second.job_id in left, other.job_id in left) == (False, False, True)
    assert all(SPECIMEN.encode() not in path.read_bytes() for path in new.rglob("*") if path.is_file())


def test_the_command_erases_and_prints_the_certificate(tmp_path: Path) -> None:
    with serving(tmp_path / "service") as service:
        put_result(service, tmp_path / "one", specimen_id=SPECIMEN)
        folder = service.settings.data_dir
    out = tmp_path / "certificate.json"
    arguments = ("erase", "--specimen", SPECIMEN, "--yes", "--certificate", str(out))
    done = specimap({"data_dir": folder}, *arguments)
    assert done.returncode == 0, done.stderr
    certificate = json.loads(out.read_text())
    assert json.loads(done.stdout) == certificate
    assert certificate["by"] == "cli"
    assert len(erased_before(folder / LIST)) == 1
    missing = specimap({"data_dir": folder}, *arguments)
    assert (missing.returncode, "not_found" in missing.stderr) == (2, True)

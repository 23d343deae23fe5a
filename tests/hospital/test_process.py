"""The hospital's process: alone, and beside the service; nothing that is away ends it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_infra.database import Database
from specimap_infra.tables import DicomInstance
from tests.support.databases import create_tables
from tests.support.hospital_scene import KEY, as_json
from tests.support.orthanc import RunningOrthanc
from tests.support.outbox_scene import add_cloud, with_settings
from tests.support.result_scene import put_result
from tests.support.serve_scene import running
from tests.support.service_scene import serving
from tests.support.worker_scene import until


def archive_settings(archive: RunningOrthanc) -> dict[str, str]:
    return {
        "SPECIMAP_PACS_URL": archive.dicomweb_url,
        "SPECIMAP_PACS_USER": archive.user,
        "SPECIMAP_PACS_PASSWORD": archive.password,
        "SPECIMAP_STUDY_KEYS": json.dumps([KEY]),
    }


def sent(folder: Path) -> int:
    database = Database.open(f"sqlite:///{folder / 'specimap.db'}")
    try:
        with database.session() as session:
            states = list(session.scalars(sa.select(DicomInstance.state)))
    finally:
        database.close()
    return len(states) if states and set(states) == {"sent"} else 0


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [("serve",), ("hospital",)])
def test_results_are_sent_by_the_service_and_by_the_process_alone(
    archive: RunningOrthanc, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    with serving(tmp_path / "data", study_keys=[KEY]) as service:
        result = put_result(service, tmp_path / "result")
        study = f"/v1/acquisitions/{result.acquisition_id}/study"
        assert service.client().put(study, json=as_json()).status_code == 200
    with running(tmp_path / "data", *arguments, **archive_settings(archive)) as program:
        count = until(lambda: sent(tmp_path / "data"), 90, "the objects to be sent")
        assert program.process.poll() is None
    assert count >= 4
    assert not any("Quasimodo" in line for line in program.lines)


@pytest.mark.slow
def test_an_archive_that_is_away_does_not_end_it(tmp_path: Path) -> None:
    settings = with_settings(None, data_dir=tmp_path / "data", study_keys=[KEY])
    database = Database.open(settings.database)
    create_tables(database)
    add_cloud(database, settings)
    database.close()
    away = {"SPECIMAP_PACS_URL": "http://127.0.0.1:9/dicom-web", "SPECIMAP_STUDY_KEYS": json.dumps([KEY])}
    with running(tmp_path / "data", "hospital", **away) as program:
        until(lambda: any("not_reachable" in line for line in program.lines), 60, "a first attempt")
        assert program.process.poll() is None


def test_without_work_it_says_so_and_ends(tmp_path: Path) -> None:
    import os

    environment = {**os.environ, "SPECIMAP_DATA_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-m", "specimap_hospital"], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert "SPECIMAP_PACS_URL" in done.stderr

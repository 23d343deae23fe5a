"""Artefacts of an acquisition whose jobs finish a stage at the same moment."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_core.pipeline.artefact_store import Store
from specimap_infra import jobs
from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, Artefact, Job
from specimap_workers.artefacts import Artefacts

JOBS = 6


class Together(Storage):
    """Lets nobody go on who has stored a file until all have."""

    stored: threading.Barrier

    def put_file(self, key: str, source: Path) -> None:
        super().put_file(key, source)
        self.stored.wait(20)


def running(tables: Database, acquisition: str) -> str:
    """A job of the acquisition, taken by the executor of the job's own name."""
    job_id = new_id("job")
    with tables.session() as session:
        session.add(
            Job(
                id=job_id,
                acquisition_id=acquisition,
                settings={},
                priority=5,
                state="queued",
                request_hash="",
                correlation_id="test",
                created_by="key_test",
            )
        )
    with tables.session() as session:
        assert jobs.claim(session, job_id, f"here:{job_id}") is not None
    return job_id


@pytest.mark.parametrize("same", [True, False], ids=["same settings", "other settings"])
def test_of_jobs_that_finish_a_stage_at_once_one_artefact_stays(tables: Database, tmp_path: Path, same: bool) -> None:
    acquisition = new_id("acq")
    with tables.session() as session:
        session.add(
            Acquisition(
                project_id=DEFAULT_PROJECT,
                id=acquisition,
                specimen_id="S1",
                dictionary="DICT_4X4_50",
                edge_mm=6.8,
                notes="",
                created_by="key_test",
            )
        )
    storage = Together.open(load_settings(data_dir=tmp_path / "data"))
    storage.stored = threading.Barrier(JOBS)
    artefacts = Artefacts(tables, storage, acquisition)

    def finish(number: int) -> str:
        job_id = running(tables, acquisition)
        key = "k" if same else f"k{number}"
        folder = tmp_path / job_id
        left = Store(folder / "stages").path("adjust", key)
        left.parent.mkdir(parents=True)
        left.write_bytes(job_id.encode())
        artefacts.keep("adjust", key, folder, 1.5, job_id, f"here:{job_id}")
        return job_id

    with ThreadPoolExecutor(JOBS) as pool:
        ids = list(pool.map(finish, range(JOBS)))

    with tables.session() as session:
        (row,) = session.scalars(sa.select(Artefact)).all()
        assert all(session.get_one(Job, job_id).seconds == {"adjust": 1.5} for job_id in ids)
    assert [stored.key for stored in storage.list(f"acquisitions/{acquisition}/stages")] == [row.storage_key]
    assert storage.read(row.storage_key).decode() in ids

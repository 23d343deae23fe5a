"""docs/service.md: its program runs against a service."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.ids import new_id
from specimap_infra.tables import CloudRow, Job
from tests.support.places import DOCS, SAMPLES
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running
from tests.support.upload_scene import photos
from tests.support.worker_scene import until

PAGE = DOCS / "service.md"
EXECUTOR = "host:0:page"


@contextmanager
def working(service: Running, result: Result) -> Iterator[None]:
    """A worker that ends the first job with ``result``."""

    def queued() -> str | None:
        with service.database.session() as session:
            return session.scalar(sa.select(Job.id).where(Job.state == "queued"))

    def work() -> None:
        job_id = str(until(queued, 60, "a job"))
        with service.database.session() as session:
            job = jobs.claim(session, job_id, EXECUTOR)
            found = session.scalar(sa.select(CloudRow).where(CloudRow.id == result.cloud_id))
            assert job is not None
            assert found is not None
            session.add(
                CloudRow(
                    id=new_id("cloud"),
                    job_id=job_id,
                    acquisition_id=job.acquisition_id,
                    prefix=found.prefix,
                    points=found.points,
                    bands=found.bands,
                    size=found.size,
                    report=found.report,
                )
            )
            session.flush()
            jobs.finish(session, job_id, EXECUTOR, "succeeded")

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join()


def test_program_of_the_page(
    service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = put_result(service, tmp_path / "result")
    (program,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    (tmp_path / "photos").mkdir()
    for photo in photos()[:6]:
        shutil.copy(photo, tmp_path / "photos")
    for end in ("hdr", "raw"):
        shutil.copy(SAMPLES / "hsi" / f"hsi.{end}", tmp_path / f"scan.{end}")
    monkeypatch.chdir(tmp_path)
    environment = {
        "SPECIMAP_URL": service.url,
        "SPECIMAP_KEY": service.key(["upload", "read"]),
        "NO_PROXY": "127.0.0.1",
        "no_proxy": "127.0.0.1",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    # Its place is the specimen's; the points of this cloud lie elsewhere.
    there = program.replace("(3.0, -2.0, 8.0)", "(2.0, -3.0, 0.0)")
    assert there != program
    with working(service, result):
        exec(compile(there, str(PAGE), "exec"), {})
    near = result.cloud.in_radius((2.0, -3.0, 0.0), 1.5)
    assert len(near) > 20
    assert capsys.readouterr().out == f"({len(near)}, 2) 0.1 mm\n"

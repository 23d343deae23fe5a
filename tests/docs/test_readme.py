"""README.md and the pages beside it: their programs run, and the commands that they name exist."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import sqlalchemy as sa
import typer
from typer.core import TyperGroup

from specimap_cli.app import app
from specimap_infra import jobs
from specimap_infra.ids import new_id
from specimap_infra.tables import CloudRow, Job
from tests.support.places import ROOT, SAMPLES
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running
from tests.support.upload_scene import photos
from tests.support.worker_scene import until

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "Makefile"]
EXECUTOR = "host:0:readme"


@contextmanager
def working(service: Running, result: Result) -> Iterator[None]:
    """A worker that ends the first job with a result that is there."""

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


def test_program_of_the_readme(
    service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = put_result(service, tmp_path / "result")
    (program,) = re.findall(r"^```python\n(.*?)^```", PAGES[0].read_text("utf-8"), re.MULTILINE | re.DOTALL)
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
        exec(compile(there, str(PAGES[0]), "exec"), {})
    near = result.cloud.in_radius((2.0, -3.0, 0.0), 1.5)
    assert len(near) > 20
    assert capsys.readouterr().out == f"({len(near)}, 2) 0.1 mm\n"


def commands() -> dict[str, set[str]]:
    """Options of all commands by what a person types, `keys create` among them."""
    root = typer.main.get_command(app)
    assert isinstance(root, TyperGroup)
    found: dict[str, set[str]] = {}
    for name, command in root.commands.items():
        inner = command.commands if isinstance(command, TyperGroup) else {}
        for words, leaf in ((name, command), *((f"{name} {below}", leaf) for below, leaf in inner.items())):
            found[words] = {option for p in leaf.params for option in (*p.opts, *p.secondary_opts)}
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.name))
def test_commands_on_the_pages_exist(page: Path) -> None:
    known, text = commands(), page.read_text("utf-8").replace("\\\n", " ")
    for words in re.findall(r"(?:/|`|=\S+ )specimap ([a-z][^`\n#]*)", text):
        two, one = " ".join(words.split()[:2]), words.split()[0]
        options = known.get(two, known.get(one))
        assert options is not None, f"{page.name}: specimap {words}"
        assert set(re.findall(r"(?<!\S)--[a-z-]+", words)) <= options, f"{page.name}: specimap {words}"


def test_commands_that_do_not_exist_are_seen() -> None:
    known = commands()
    assert {"run", "serve", "worker", "demo", "keys create", "keys list", "keys revoke"} <= set(known)
    assert "--no-worker" in known["serve"]
    assert "--scopes" not in known["keys create"]

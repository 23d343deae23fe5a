"""Processes that read uploaded files reach those files alone: every way out is tried from inside each kind of them."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from specimap_core.sandbox import Mode, protection
from specimap_infra.settings import load_settings
from specimap_service.acquisitions.judge import Judge
from specimap_workers.stage_process import Processes
from specimap_workers.workspaces import Workspaces
from tests.support import escapes

pytestmark = pytest.mark.skipif(not protection().whole, reason="this kernel does not confine")

TEXT = Path(escapes.__file__).read_text("utf-8")

JUDGING = f"""{TEXT}
import json
from specimap_core.screening import process as child
from specimap_core.screening.verdict import Verdict

def escape(task):
    targets = json.loads(Path(task["path"]).read_text())
    found = tried({{**targets, "own": task["scratch"], "parent": os.getppid()}})
    return Verdict(facts={{"found": [f"{{name}}: {{how}}" for name, how in found.items()]}})

child.TASKS["cube"] = escape
child.main()
"""
STAGE = f"""{TEXT}
import json
from specimap_workers import stage_main

def escape(spec, out):
    found = tried({{**json.loads((Path(spec["inputs"]["photos"]) / "targets").read_text()), "own": spec["out"]}})
    (Path(spec["out"]) / "found").write_text(json.dumps(found))
    stage_main._send(out, event="done", seconds=0)

stage_main._run = escape
stage_main.main()
"""
EXPORT = f"""{TEXT}
import json, sys
print(json.dumps(tried(json.loads(sys.argv[1]))))
"""


@pytest.fixture
def targets(tmp_path: Path) -> Iterator[dict[str, Any]]:
    """The things to get at, as of :func:`escapes.ways`, but ``own`` and ``link``."""
    elsewhere = tmp_path / "data" / "storage"
    elsewhere.mkdir(parents=True)
    for name in ("secret", "spare", "other"):
        (elsewhere / name).write_text("secret")
        (elsewhere / name).chmod(0o600)
    database = tmp_path / "data" / "specimap.db"
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("CREATE TABLE api_key (hash TEXT)")
    with (
        socket.create_server(("127.0.0.1", 0)) as tcp,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        socket.socket(socket.AF_UNIX) as unix,
        socket.socket(socket.AF_UNIX) as abstract,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as datagrams,
    ):
        udp.bind(("127.0.0.1", 0))
        unix.bind(str(tmp_path / "s"))
        unix.listen()
        datagrams.bind(str(tmp_path / "d"))
        name = f"\0specimap-{os.getpid()}-{tmp_path.name}"
        abstract.bind(name)
        abstract.listen()
        queue = escapes.LIBRARY.msgget(0, 0o600)
        yield {
            "secret": str(elsewhere / "secret"),
            "elsewhere": str(elsewhere),
            "database": str(database),
            "parent": os.getpid(),
            "tcp": tcp.getsockname()[1],
            "udp": udp.getsockname()[1],
            "unix": str(tmp_path / "s"),
            "abstract": name,
            "datagrams": str(tmp_path / "d"),
            "queue": queue,
        }
        escapes.LIBRARY.msgctl(queue, 0, None)


def linked(folder: Path, targets: dict[str, Any]) -> Path:
    link = folder / "link"
    link.symlink_to(targets["secret"])
    plain = folder / "plain"
    plain.write_text("given")
    plain.chmod(0o600)
    return link


def untouched(targets: dict[str, Any]) -> None:
    elsewhere = Path(targets["elsewhere"])
    assert {p.name for p in elsewhere.iterdir()} == {"secret", "spare", "other"}
    assert Path(targets["secret"]).read_text() == "secret"
    assert Path(targets["secret"]).stat().st_mode & 0o777 == 0o600


def in_judging(targets: dict[str, Any], folder: Path, mode: Mode) -> dict[str, str]:
    settings = load_settings(data_dir=folder.parent / "data", sandbox=mode)
    judge = Judge(settings, os.environ, (sys.executable, "-c", JUDGING))
    task = folder / "task"
    task.mkdir(parents=True)
    (task / "cube").write_text(json.dumps({**targets, "link": str(linked(task, targets))}))
    try:
        verdict = judge.cube(task / "cube")
    finally:
        judge.close()
    return dict(line.split(": ", 1) for line in verdict["found"])


def in_stage(targets: dict[str, Any], folder: Path, mode: Mode) -> dict[str, str]:
    inputs, out = folder / "inputs", folder / "out"
    (inputs / "photos").mkdir(parents=True)
    out.mkdir()
    workspaces = Workspaces(folder / "work", "test", mode, (folder.parent / "data",))

    async def ignore(stage: str, share: float) -> None:
        del stage, share

    async def run() -> None:
        processes = Processes(workspaces, (sys.executable, "-c", STAGE))
        process = await processes.take()
        with process.workspace.holding(inputs, out) as (given, own):
            link = linked(given / "photos", targets)
            (given / "photos" / "targets").write_text(json.dumps({**targets, "link": str(link)}))
            spec = {"stage": "reconstruct", "inputs": {"photos": str(given / "photos")}, "out": str(own)}
            await process.run(spec, ignore, 120)
        await process.end()
        await processes.close()

    asyncio.run(run())
    assert not list((folder / "work").iterdir())
    return dict(json.loads((out / "found").read_text()))


def in_export(targets: dict[str, Any], folder: Path, mode: Mode) -> dict[str, str]:
    workspaces = Workspaces(folder / "work", "test", mode, (folder.parent / "data",))
    workspace = workspaces.new()
    described = json.dumps({**targets, "own": str(workspace.own), "link": str(linked(workspace.given, targets))})
    command = workspaces.confined([sys.executable, "-c", EXPORT, described], workspace, backends=False)
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env=workspaces.environment(workspace), check=True
    )
    workspace.remove()
    return dict(json.loads(done.stdout))


KINDS = {"judging": in_judging, "stage": in_stage, "export": in_export}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_no_way_leads_out(kind: str, targets: dict[str, Any], tmp_path: Path) -> None:
    found = KINDS[kind](targets, tmp_path / "own", "require")
    assert len(found) == len(escapes.ways({**targets, "own": ".", "link": "link"}))
    assert {name: how for name, how in found.items() if how == "out"} == {}
    # What stops them is the confinement, not a mistake of the test.
    mistakes = ("TypeError", "NameError", "AttributeError", "FileNotFoundError")
    assert not [how for how in found.values() if how.startswith(mistakes)]
    untouched(targets)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_they_lead_out_where_nothing_is_confined(kind: str, targets: dict[str, Any], tmp_path: Path) -> None:
    found = KINDS[kind](targets, tmp_path / "own", "off")
    # These depend on rights of the user and on the kernel, with or without us.
    moody = {
        "use io_uring",
        "trace the parent",
        "read the parent's memory",
        "open the parent's memory",
        "read a disk",
        "read /etc/shadow",
        "list the parent's open files",
        "make a namespace",
        "read it by the parent's root",
        "be another user",
        "make a device",
        "change the attributes of an open file",
        "change a file's attributes",
    }
    assert {name: how for name, how in found.items() if how != "out" and name not in moody} == {}

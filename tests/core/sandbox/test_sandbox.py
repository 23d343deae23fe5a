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

from specimap_core.errors import SettingsError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES, backends_from
from specimap_core.sandbox import Mode, Protection, Reach, confined, program_rules, protection
from specimap_core.sandbox.launch import NOT_CONFINED
from specimap_core.sandbox.places import interpreter_places
from specimap_infra import confinement
from specimap_infra.confinement import check_confinement
from specimap_infra.settings import load_settings
from specimap_service.acquisitions.judge import Judge
from specimap_workers.stage_process import Processes
from specimap_workers.workspaces import Workspaces, is_plain
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


@pytest.mark.parametrize("kind", KINDS)
def test_no_way_leads_out(kind: str, targets: dict[str, Any], tmp_path: Path) -> None:
    found = KINDS[kind](targets, tmp_path / "own", "require")
    assert len(found) == len(escapes.ways({**targets, "own": ".", "link": "link"}))
    assert {name: how for name, how in found.items() if how == "out"} == {}
    # What stops them is the confinement, not a mistake of the test.
    mistakes = ("TypeError", "NameError", "AttributeError", "FileNotFoundError")
    assert not [how for how in found.values() if how.startswith(mistakes)]
    untouched(targets)


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


def test_no_capability_is_left(tmp_path: Path) -> None:
    program = "print(*[line.split()[1] for line in open('/proc/self/status') if line.startswith(('Cap', 'NoNew'))])"
    inner = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {program!r}], check=True)"
    for code in (program, inner):
        done = subprocess.run(
            confined([sys.executable, "-c", code], Reach(write=[tmp_path], read=[Path("/proc")]), "require"),
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        assert done.stdout.split() == ["0" * 16] * 5 + ["1"]


def test_a_workspace_gives_the_inputs_to_read_alone(tmp_path: Path) -> None:
    workspaces = Workspaces(tmp_path / "work", "test", "require", (tmp_path,))
    workspace = workspaces.new()
    (workspace.given / "photo").write_text("original")
    program = "import sys; print(open(sys.argv[1]).read()); open(sys.argv[1], 'a').write('changed')"
    command = workspaces.confined(
        [sys.executable, "-c", program, str(workspace.given / "photo")], workspace, backends=False
    )
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stdout == "original\n"
    assert "PermissionError" in done.stderr
    assert (workspace.given / "photo").read_text() == "original"


def test_stages_reach_what_the_environment_names_for_backends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in BACKEND_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    blobs, weights, home, cache = (tmp_path / name for name in ("blobs", "weights", "home", "cache"))
    for folder in (blobs, weights, home):
        folder.mkdir()
    (blobs / "blob").write_text("numbers")
    (weights / "model.safetensors").symlink_to(blobs / "blob")
    (home / "code.py").write_text("code")
    monkeypatch.setenv("SPECIMAP_DA3_WEIGHTS", str(weights))
    monkeypatch.setenv("SPECIMAP_MAST3R_HOME", str(home))
    monkeypatch.setenv("SPECIMAP_MAST3R_CACHE", str(cache))
    workspaces = Workspaces(tmp_path / "work", "test", "require", (), backends_from(os.environ))
    workspace = workspaces.new()
    program = (
        "import sys; print(open(sys.argv[1]).read(), open(sys.argv[2]).read());"
        "open(sys.argv[3], 'w').close(); open(sys.argv[2], 'w')"
    )
    places = [str(weights / "model.safetensors"), str(home / "code.py"), str(cache / "new")]
    for backends in (True, False):
        command = workspaces.confined([sys.executable, "-c", program, *places], workspace, backends=backends)
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert "PermissionError" in done.stderr
        assert done.stdout == ("numbers code\n" if backends else "")
    assert (cache / "new").exists()
    assert (home / "code.py").read_text() == "code"


def test_a_child_process_is_confined_too_and_pipes_between_them_work(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "own").mkdir()
    program = (
        "import os, signal, subprocess, sys\n"
        "inner = 'import sys; print(sys.stdin.read()); open(sys.argv[1])'\n"
        "pipes = dict.fromkeys(('stdin', 'stdout', 'stderr'), subprocess.PIPE)\n"
        "child = subprocess.Popen([sys.executable, '-c', inner, sys.argv[1]], start_new_session=True, **pipes)\n"
        "out, err = child.communicate(b'heard')\n"
        "print(out.decode().strip(), 'PermissionError' in err.decode())\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'], start_new_session=True)\n"
        "os.killpg(child.pid, signal.SIGKILL)\n"
        "print(child.wait())\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "secret")]
    command = confined(command, Reach(write=[tmp_path / "own"]), "require")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stdout.split("\n")[:2] == ["heard True", "-9"], done.stderr


def test_other_processes_stay_closed_where_proc_is_open(tmp_path: Path) -> None:
    """As it is where a GPU's driver is asked through it."""
    program = (
        "import os\n"
        "open('/proc/self/maps').read(1)\n"
        "for name in ('environ', 'maps', 'mem', 'fd/0', 'root/etc/passwd', 'cwd/x'):\n"
        "    try: open(f'/proc/{os.getppid()}/{name}')\n"
        "    except PermissionError: print(name)\n"
    )
    command = confined([sys.executable, "-c", program], Reach(read=[Path("/proc")]), "require")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == ["environ", "maps", "mem", "fd/0", "root/etc/passwd", "cwd/x"]


def test_no_rule_covers_a_private_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modules = tmp_path / "modules"
    (modules / "data").mkdir(parents=True)
    (modules / "module.py").write_text("")
    (tmp_path / "plain").mkdir()
    monkeypatch.syspath_prepend(str(modules))
    monkeypatch.syspath_prepend(str(tmp_path / "plain"))
    named = [place for place, _ in program_rules(Reach(keep_from=[modules / "data"]))]
    assert str(tmp_path / "plain") in named
    assert not [place for place in named if Path(place) == modules or modules in Path(place).parents]
    # An interpreter next to the data is needed all the same: its files are named, and the data are not.
    monkeypatch.setattr(sys, "prefix", str(modules))
    named = [place for place, _ in program_rules(Reach(keep_from=[modules / "data"]))]
    assert str(modules / "module.py") in named
    assert not {str(modules), str(modules / "data")} & set(named)
    monkeypatch.chdir(tmp_path / "plain")
    assert str(tmp_path / "plain") not in [place for place, _ in program_rules(Reach())]


def test_an_interpreter_in_a_home_folder_opens_no_more_than_itself(tmp_path: Path) -> None:
    home, own = tmp_path / "home", tmp_path / "venv"
    for folder in (home, own):
        (folder / "bin").mkdir(parents=True)
        (folder / "bin" / "python").symlink_to(sys.executable)
    (own / "pyvenv.cfg").write_text("home = /usr/bin\n")
    assert home not in (found := list(interpreter_places(str(home / "bin" / "python"))))
    assert home / "bin" / "python" in found
    assert own in interpreter_places(str(own / "bin" / "python"))


def test_a_command_that_cannot_be_confined_is_not_run(tmp_path: Path) -> None:
    command = confined([str(tmp_path / "none")], Reach(), "require")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == NOT_CONFINED
    assert "could not be confined" in done.stderr


@pytest.mark.parametrize("version", [0, 1])
def test_without_landlock_what_there_is_holds(version: int, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    program = (
        "import os, socket, sys\n"
        "from specimap_core.sandbox import Confinement, landlock\n"
        f"landlock.abi = lambda: {version}\n"
        "Confinement([], sys.argv[1]).enter(alone=False)\n"
        "os.rename('file', 'folder/file')\n"
        "try: socket.socket()\n"
        "except PermissionError: print('no socket')\n"
    )
    for mode in ("best-effort", "require"):
        command = [sys.executable, "-c", program, mode]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
        assert (done.stdout, done.returncode) == (("no socket\n", 0) if mode == "best-effort" else ("", 1)), done.stderr


@pytest.mark.parametrize(
    ("landlock", "seccomp", "missing"),
    [(0, True, "Landlock"), (7, False, "seccomp"), (1, False, "Landlock and seccomp")],
)
def test_a_kernel_without_it_is_warned_of_or_refused(
    landlock: int, seccomp: bool, missing: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    warned: list[str] = []

    class Log:
        def warning(self, text: str, **_: object) -> None:
            warned.append(text)

    monkeypatch.setattr(confinement, "protection", lambda: Protection(landlock, seccomp))
    monkeypatch.setattr(confinement, "logger", Log)
    with pytest.raises(SettingsError, match=missing) as caught:
        check_confinement(load_settings(data_dir=tmp_path, sandbox="require"))
    assert caught.value.details["setting"] == "sandbox"
    assert not warned
    check_confinement(load_settings(data_dir=tmp_path))
    assert missing in warned.pop()
    check_confinement(load_settings(data_dir=tmp_path, sandbox="off"))
    assert "off" in warned.pop()
    monkeypatch.setattr(confinement, "protection", lambda: Protection(7, True))
    check_confinement(load_settings(data_dir=tmp_path, sandbox="require"))
    assert not warned


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_what_leads_elsewhere_is_no_result(kind: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.zarr").mkdir()
    (tmp_path / "cloud.zarr" / "zarr.json").write_text("{}")
    assert is_plain(tmp_path)
    place = tmp_path / "cloud.zarr" / "c"
    if kind == "link":
        place.symlink_to("/etc")
    else:
        os.mkfifo(place)
    assert not is_plain(tmp_path)

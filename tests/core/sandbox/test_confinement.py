"""Rules of the confinement: rights, places and child processes, and a kernel that lacks a part of it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from specimap_core.errors import SettingsError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES, backends_from
from specimap_core.sandbox import Protection, Reach, confined, landlock, program_rules, protection
from specimap_core.sandbox.launch import NOT_CONFINED
from specimap_core.sandbox.places import interpreter_places
from specimap_infra import confinement
from specimap_infra.confinement import check_confinement
from specimap_infra.settings import load_settings
from specimap_workers.workspaces import Workspaces, is_plain

pytestmark = pytest.mark.skipif(not protection().whole, reason="this kernel does not confine")


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


def test_of_a_source_folder_the_package_alone_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "service" / "specimap_other"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package.parent / "notes").write_text("")
    monkeypatch.syspath_prepend(str(package.parent))
    rights = dict(program_rules(Reach()))
    assert rights[str(package)] == landlock.READ
    assert rights[str(package.parent)] == landlock.READ_DIR
    assert str(package.parent / "notes") not in rights


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

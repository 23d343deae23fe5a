"""A script in a process of its own: answers, progress, errors with codes, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from specimap_core.errors import (
    BackendFailedError,
    BackendUnavailableError,
    CancelledError,
    PhotosNotConnectedError,
    SpecimapError,
)
from specimap_core.sandbox.process import child_environment, leaf_of
from tests.support.child_scripts import LONG, ask
from tests.support.places import ROOT

SOON = 5.0
"""Seconds within which killed processes must be gone: a kill takes milliseconds, a crowded machine more."""


def ended(pid: int) -> bool:
    """Whether a process is gone within a while; a zombie that nobody has collected counts as gone."""
    end = time.monotonic() + SOON
    while time.monotonic() < end:
        stat = Path(f"/proc/{pid}/stat")
        try:
            if stat.read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.02)
    return False


# ---- answers ------------------------------------------------------------------------------------------


def test_arrays_go_there_and_back(tmp_path: Path) -> None:
    given = {"a": np.arange(6.0).reshape(2, 3), "names": np.array(["x", "y"])}
    answer = ask(tmp_path, "return {'a': arrays['a'] * request['factor']}, {'names': list(arrays['names'])}", given)
    assert np.array_equal(answer.arrays["a"], 3 * given["a"])
    assert answer.facts == {"names": ["x", "y"]}


def test_progress_adds_the_steps_by_their_weight_and_never_falls(tmp_path: Path) -> None:
    shares: list[float] = []
    body = "for n, s in (('first', 1), ('second', .5), ('first', 0), ('other', 1)): step(n, s); time.sleep(.05)\n"
    ask(tmp_path, body + "return {}, {}", progress=shares.append)
    assert {0.0, 0.25, 0.25 + 0.75 / 2} <= set(shares)
    assert shares == sorted(shares)
    assert max(shares) == 0.25 + 0.75 / 2


def test_what_libraries_print_does_not_break_the_answer(tmp_path: Path) -> None:
    body = "print('{\"done\": 1}'); os.write(1, b'noise'); os.write(2, b'noise')\nreturn {}, {'fine': True}"
    assert ask(tmp_path, body).facts == {"fine": True}


def test_child_runs_in_a_folder_of_its_own_without_secrets_and_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPECIMAP_KEY", "secret")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    body = "import tempfile\nreturn {}, dict(os.environ, cwd=os.getcwd(), place=request['folder'])"
    facts = ask(tmp_path, body, environment={"MORE": "1"}).facts
    assert not [name for name in facts if name.startswith(("SPECIMAP_", "AWS_"))]
    assert facts["HF_HUB_OFFLINE"] == facts["TRANSFORMERS_OFFLINE"] == facts["MORE"] == "1"
    assert facts["cwd"] == facts["place"] == facts["TMPDIR"]
    assert Path(facts["place"]).parent == tmp_path / "scratch"
    assert "SPECIMAP_KEY" not in child_environment(tmp_path, {})


@pytest.mark.parametrize(
    "attempt",
    [
        "import socket; socket.create_connection(('127.0.0.1', 9))",
        "import urllib.request; urllib.request.urlopen('http://localhost:9/')",
        "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', 9))",
    ],
)
def test_child_reaches_no_network(tmp_path: Path, attempt: str) -> None:
    with pytest.raises(BackendFailedError, match="no network"):
        ask(tmp_path, attempt + "\nreturn {}, {}")


def test_child_knows_specimap_only_by_its_own_files(tmp_path: Path) -> None:
    # Under an interpreter without anything installed but NumPy, errors must still arrive typed.
    body = (
        "from specimap_core.errors import PhotosNotConnectedError\n"
        "heavy = sorted({'cv2', 'scipy', 'pycolmap', 'open3d'} & set(sys.modules))\n"
        "raise PhotosNotConnectedError('Apart.', advice='Do.', photos=['a'], heavy=heavy)"
    )
    with pytest.raises(PhotosNotConnectedError, match="Apart") as caught:
        ask(tmp_path, body)
    assert caught.value.advice == "Do."
    assert caught.value.details == {"photos": ["a"], "heavy": []}


def test_extra_path_comes_first(tmp_path: Path) -> None:
    (tmp_path / "extra").mkdir()
    (tmp_path / "extra" / "upstream_of_ours.py").write_text("WHERE = 'extra'\n", "utf-8")
    body = "import upstream_of_ours\nreturn {}, {'where': upstream_of_ours.WHERE}"
    assert ask(tmp_path, body, extra_path=[tmp_path / "extra"]).facts == {"where": "extra"}


def test_folder_can_be_looked_at_before_it_goes(tmp_path: Path) -> None:
    seen: list[list[str]] = []
    ask(tmp_path, "return {}, {}", keep=lambda folder: seen.append(sorted(p.name for p in folder.iterdir())))
    assert seen == [["answer.npz", "arrays.npz", "log.txt", "request.json"]]


# ---- failures -----------------------------------------------------------------------------------------


def test_a_missing_module_is_named(tmp_path: Path) -> None:
    with pytest.raises(BackendUnavailableError, match="no_such_library") as caught:
        ask(tmp_path, "import no_such_library")
    assert caught.value.details["module"] == "no_such_library"
    assert "SPECIMAP_MAST3R_PYTHON" in caught.value.advice


@pytest.mark.parametrize("python", ["/nowhere/python", "/etc/passwd"])
def test_an_interpreter_that_does_not_start(tmp_path: Path, python: str) -> None:
    with pytest.raises(BackendUnavailableError, match=python) as caught:
        ask(tmp_path, "return {}, {}", python=python)
    assert "SPECIMAP_MAST3R_PYTHON" in caught.value.advice


def test_an_interpreter_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(BackendFailedError, match="status 1"):
        ask(tmp_path, "return {}, {}", python="/bin/false")


def test_an_exception_keeps_its_words_its_place_and_the_last_lines(tmp_path: Path) -> None:
    with pytest.raises(BackendFailedError, match=r"AssertionError: \(depth > 0\)") as caught:
        ask(tmp_path, "print('before')\nassert False, '(depth > 0)'")
    assert caught.value.details["at"] == "script.py:6"
    lines = caught.value.details["last_lines"]
    assert isinstance(lines, list)
    assert lines[0] == "before"
    assert lines[-1] == "AssertionError: (depth > 0)"


@pytest.mark.parametrize(
    "body",
    [
        "raise MemoryError",
        "class OutOfMemoryError(RuntimeError): pass\nraise OutOfMemoryError('CUDA out of memory. Tried 20 GiB')",
        "try:\n    raise MemoryError\nexcept MemoryError as e:\n    raise RuntimeError('loading failed') from e",
        "os.kill(os.getpid(), 9)",
    ],
)
def test_exhausted_memory_is_reported_as_such(tmp_path: Path, body: str) -> None:
    with pytest.raises(BackendFailedError, match="out of memory") as caught:
        ask(tmp_path, body)
    assert caught.value.details["reason"] == "out_of_memory"
    assert "fewer photos" in caught.value.advice


def test_a_crash_in_native_code(tmp_path: Path) -> None:
    with pytest.raises(BackendFailedError, match=r"SIGSEGV.*the last words") as caught:
        ask(tmp_path, "print('bar 1\\rbar 2')\nprint('the last words')\nos.kill(os.getpid(), 11)")
    assert caught.value.details["last_lines"] == ["bar 2", "the last words"]


def test_ending_without_an_answer(tmp_path: Path) -> None:
    with pytest.raises(BackendFailedError, match="status 3"):
        ask(tmp_path, "os._exit(3)")


def test_leaves_are_found_by_code() -> None:
    assert leaf_of("photos_not_connected") is PhotosNotConnectedError
    assert leaf_of("internal_error") is SpecimapError
    assert leaf_of("import") is leaf_of("memory") is leaf_of("crash") is None


# ---- endings ------------------------------------------------------------------------------------------


def pids_in(folder: Path) -> list[int]:
    return [int(p) for p in (folder / "pids").read_text().split()]


def test_cancelling_kills_the_child_and_what_it_started(tmp_path: Path) -> None:
    cancelled_at = 0.0

    def progress(share: float) -> None:
        nonlocal cancelled_at
        if share >= 0.25:
            cancelled_at = time.monotonic()
            raise CancelledError("Stop.")

    with pytest.raises(CancelledError):
        ask(tmp_path, LONG, progress=progress)
    assert time.monotonic() - cancelled_at < SOON
    pids = pids_in(tmp_path)
    assert len(pids) == 2
    assert all(ended(pid) for pid in pids)


def test_cancelling_takes_effect_while_the_child_is_silent(tmp_path: Path) -> None:
    started = time.monotonic()

    def progress(share: float) -> None:
        if (tmp_path / "pids").exists() and time.monotonic() - started > 1:
            raise CancelledError("Stop.")

    with pytest.raises(CancelledError):
        ask(tmp_path, LONG, progress=progress)
    assert all(ended(pid) for pid in pids_in(tmp_path))


PARENT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from tests.support.child_scripts import LONG, ask
ask(Path({folder!r}), LONG)
"""


def test_the_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    program = PARENT.format(tests=str(ROOT), folder=str(tmp_path))
    parent = subprocess.Popen([sys.executable, "-c", program])
    try:
        end = time.monotonic() + 60
        while not ((tmp_path / "pids").exists() and (tmp_path / "pids").read_text().endswith(" ")):
            assert time.monotonic() < end
            assert parent.poll() is None
            time.sleep(0.05)
        pids = pids_in(tmp_path)
        assert all(Path(f"/proc/{pid}").exists() for pid in pids)
    finally:
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
    assert all(ended(pid) for pid in pids)
    end = time.monotonic() + SOON
    while list((tmp_path / "scratch").iterdir()) and time.monotonic() < end:
        time.sleep(0.1)
    assert list((tmp_path / "scratch").iterdir()) == []

"""How child processes that exchange JSON lines end: by a signal, with their parent, and with all they have started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from specimap_core.sandbox import json_lines
from specimap_core.sandbox.json_lines import (
    JsonLineProcess,
    ProcessEndedError,
    end_text,
)
from tests.support.json_line_scene import PATIENCE_SECONDS, SLEEPER, is_gone, open_descriptors, start
from tests.support.places import ROOT

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc"),
    pytest.mark.usefixtures("descriptors"),
]


# ---- ends ---------------------------------------------------------------------------------------------


def test_death_by_a_signal() -> None:
    with start("print('why', file=sys.stderr); os.kill(os.getpid(), signal.SIGSEGV)") as process:
        with pytest.raises(ProcessEndedError, match="SIGSEGV") as caught:
            process.receive(PATIENCE_SECONDS)
        assert (caught.value.status, caught.value.tail) == (-signal.SIGSEGV, ["why"])
        with pytest.raises(ProcessEndedError, match="SIGSEGV"):
            process.receive(0)


def test_ends_in_words() -> None:
    assert (end_text(0), end_text(3), end_text(-9)) == ("with status 0", "with status 3", "by SIGKILL")


def test_messages_before_the_end_are_received_first() -> None:
    with start('print(\'{"n": 1}\\n{"n": 2}\', flush=True)') as process:
        while process.alive:
            time.sleep(0.01)
        assert [process.receive(0)["n"] for _ in range(2)] == [1, 2]
        with pytest.raises(ProcessEndedError):
            process.receive(PATIENCE_SECONDS)


def test_a_process_that_closes_its_output_has_not_ended() -> None:
    with start("os.close(1); os.write(2, b'x' * 1_000_000); time.sleep(1); os._exit(5)") as process:
        with pytest.raises(TimeoutError):
            process.receive(0.2)
        with pytest.raises(ProcessEndedError) as caught:
            process.receive(PATIENCE_SECONDS)
        assert caught.value.status == 5


def test_a_process_that_closes_its_output_and_runs_on_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_lines, "SILENT_SECONDS", 0.3)
    with start("os.write(2, b'bye'); os.close(1); time.sleep(600)") as process:
        with pytest.raises(ProcessEndedError) as caught:
            process.receive(PATIENCE_SECONDS)
        assert (caught.value.status, caught.value.tail) == (0, ["bye"])
        pid = process.pid
    assert is_gone(pid)


@pytest.mark.parametrize("how", ["running", "ended"])
def test_closing_ends_what_the_process_has_started(how: str) -> None:
    end = "time.sleep(600)" if how == "running" else "sys.exit(0)"
    with start(f"child = {SLEEPER}; print(json.dumps({{'pid': child.pid}}), flush=True); {end}") as process:
        pid = process.receive(PATIENCE_SECONDS)["pid"]
        assert Path(f"/proc/{pid}").exists()
    assert is_gone(pid)
    process.close()
    process.kill()


def test_an_escaped_grandchild_that_holds_the_pipes_holds_nobody_up() -> None:
    escaping = SLEEPER.replace("stdin=", "start_new_session=True, stdin=")
    with start(f"child = {escaping}; print(json.dumps({{'pid': child.pid}}), flush=True); os._exit(6)") as process:
        pid = process.receive(PATIENCE_SECONDS)["pid"]
        try:
            while process.alive:
                time.sleep(0.01)
            with pytest.raises(ProcessEndedError) as caught:
                process.receive(0.3)
            assert caught.value.status == 6
            begin = time.monotonic()
            process.close()
            assert time.monotonic() - begin < PATIENCE_SECONDS / 2
        finally:
            os.kill(pid, signal.SIGKILL)


def test_killing_from_another_thread_ends_the_waiting() -> None:
    with start("time.sleep(600)") as process:
        threading.Timer(0.2, process.kill).start()
        with pytest.raises(ProcessEndedError, match="SIGKILL"):
            process.receive(PATIENCE_SECONDS)


def test_closing_from_another_thread_waits_for_the_one_that_receives() -> None:
    with start("time.sleep(600)") as process:
        closing = threading.Timer(0.2, process.close)
        closing.start()
        with pytest.raises(ProcessEndedError, match="SIGKILL"):
            process.receive(PATIENCE_SECONDS)
        closing.join(PATIENCE_SECONDS)
        assert not closing.is_alive()


PARENT = """
import os, sys, time
sys.path.insert(0, {root!r})
from specimap_core.sandbox.json_lines import JsonLineProcess
child = '''
import json, os, sys, time
from specimap_core.sandbox.lifetime import die_with
die_with(int(sys.argv[1]))
print(json.dumps({{"pid": os.getpid()}}), flush=True)
time.sleep(600)
'''
process = JsonLineProcess([sys.executable, "-c", child, str(os.getpid())], env=dict(os.environ))
print(process.receive(60)["pid"], flush=True)
time.sleep(600)
"""


def test_a_process_ends_with_its_killed_parent() -> None:
    command = [sys.executable, "-c", PARENT.format(root=str(ROOT / "core"))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        try:
            pid = int(parent.stdout.readline())
            assert Path(f"/proc/{pid}").exists()
        finally:
            parent.kill()
    assert is_gone(pid)


def test_two_hundred_starts_leave_no_descriptor_no_zombie_and_no_thread(tmp_path: Path) -> None:
    before, threads = open_descriptors(), threading.active_count()
    pids = []
    for number in range(200):
        program = ["exec sleep 600", "echo '{\"n\": 1}'; exec sleep 600", "exit 3", "kill -9 $$"][number % 4]
        log = tmp_path / "log.txt" if number % 3 == 0 else None
        with JsonLineProcess(["/bin/sh", "-c", program], env=dict(os.environ), log=log) as process:
            pids.append(process.pid)
            if number % 4 == 1 and log is None:
                assert process.receive(PATIENCE_SECONDS) == {"n": 1}
            elif number % 4 > 1:
                with pytest.raises(ProcessEndedError):
                    process.receive(PATIENCE_SECONDS)
    assert open_descriptors() == before
    assert threading.active_count() == threads
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]

"""Child processes that exchange JSON lines: real ones, which stammer, flood, hang, die and leave others behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from specimap_core.sandbox import json_lines
from specimap_core.sandbox.json_lines import (
    LINE_LIMIT,
    TAIL_LINE_LENGTH,
    TAIL_LINES,
    InvalidMessageError,
    JsonLineProcess,
    ProcessEndedError,
    end_text,
)
from tests.support.places import ROOT

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc"),
    pytest.mark.usefixtures("descriptors"),
]

PATIENCE_SECONDS = 20.0
"""For what takes milliseconds, on a crowded machine."""
START = "import json, os, signal, subprocess, sys, time\n"
SLEEPER = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'], stdin=subprocess.DEVNULL)"


def start(program: str, log: Path | None = None, takes_messages: bool = True) -> JsonLineProcess:
    command = [sys.executable, "-S", "-c", START + program]
    return JsonLineProcess(command, env=dict(os.environ), log=log, takes_messages=takes_messages)


def is_gone(pid: int) -> bool:
    """Whether a process has ended; a zombie that nobody collects counts as ended."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.01)
    return False


def open_descriptors() -> set[str]:
    found = set()
    for name in os.listdir("/proc/self/fd"):
        try:
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
        except OSError:  # that of the listing itself
            continue
    return found


@pytest.fixture
def descriptors() -> Iterator[None]:
    """Asserts that the test leaves no descriptor open."""
    before = open_descriptors()
    yield
    assert open_descriptors() == before


# ---- messages -----------------------------------------------------------------------------------------


def test_messages_go_there_and_back_in_order() -> None:
    program = "for line in sys.stdin: print(json.dumps({'twice': 2 * json.loads(line)['n']}), flush=True)"
    with start(program) as process:
        for n in range(5):
            process.send({"n": n}, PATIENCE_SECONDS)
        assert [process.receive(PATIENCE_SECONDS) for _ in range(5)] == [{"twice": 2 * n} for n in range(5)]
        assert process.alive
    assert not process.alive


def test_a_line_in_pieces_is_one_message_and_lines_in_one_piece_are_several() -> None:
    program = (
        "for piece in ('{\"n', '\": ', '1}', '\\n{\"n\": 2}\\n{\"n\": 3}\\n{\"n\"'):\n"
        "    os.write(1, piece.encode()); time.sleep(0.05)\n"
    )
    with start(program) as process:
        assert [process.receive(PATIENCE_SECONDS)["n"] for _ in range(3)] == [1, 2, 3]
        # What has no end is no message.
        with pytest.raises(ProcessEndedError) as caught:
            process.receive(PATIENCE_SECONDS)
        assert caught.value.status == 0


@pytest.mark.parametrize("text", ["no json", "", "[1]", "1", "null", '{"a": ', "[" * 100_000, "\\xff\\xfe", "9" * 9000])
def test_a_line_that_is_no_object_is_refused_and_the_next_one_counts(text: str) -> None:
    with start(f"os.write(1, b'{text}' + b'\\n{{\"fine\": 1}}\\n'); time.sleep(600)") as process:
        with pytest.raises(InvalidMessageError):
            process.receive(PATIENCE_SECONDS)
        assert process.receive(PATIENCE_SECONDS) == {"fine": 1}


def test_a_line_beyond_the_limit_is_refused_before_it_ends() -> None:
    with start(f"os.write(1, b'x' * {LINE_LIMIT + 1}); time.sleep(600)") as process:
        with pytest.raises(InvalidMessageError, match="longer"):
            process.receive(PATIENCE_SECONDS)
        with pytest.raises(TimeoutError):
            process.receive(0)


def test_an_endless_line_is_refused_piece_by_piece() -> None:
    with start("while True: os.write(1, b'x' * 65536)") as process:
        for _ in range(20):
            with pytest.raises(InvalidMessageError, match="longer"):
                process.receive(PATIENCE_SECONDS)


def test_the_longest_line_is_taken() -> None:
    program = f"print(json.dumps({{'text': 'x' * {LINE_LIMIT - 100}}}), flush=True); time.sleep(600)"
    with start(program) as process:
        assert len(process.receive(PATIENCE_SECONDS)["text"]) == LINE_LIMIT - 100


def test_endless_errors_do_not_hide_the_deadline() -> None:
    with start("while True: os.write(2, b'x' * 65536)") as process:
        begin = time.monotonic()
        with pytest.raises(TimeoutError):
            process.receive(0.3)
        assert 0.3 <= time.monotonic() - begin < PATIENCE_SECONDS


def test_what_has_arrived_is_received_without_waiting() -> None:
    with start('os.write(1, b\'{"n": 1}\\n{"n": 2}\\n\'); time.sleep(600)') as process:
        assert process.receive(PATIENCE_SECONDS) == {"n": 1}
        assert process.receive(0) == {"n": 2}
        with pytest.raises(TimeoutError):
            process.receive(0)


def test_silence_until_the_deadline() -> None:
    with start("time.sleep(600)") as process:
        begin = time.monotonic()
        with pytest.raises(TimeoutError):
            process.receive(0.3)
        assert 0.3 <= time.monotonic() - begin < PATIENCE_SECONDS
        assert process.alive


def test_a_process_that_does_not_read_ends_the_sending() -> None:
    with start("time.sleep(600)") as process, pytest.raises(TimeoutError):
        process.send({"text": "x" * 10_000_000}, 0.3)


def test_a_long_message_reaches_a_process_that_complains_first() -> None:
    program = "os.write(2, b'x' * 1_000_000); print(json.dumps({'n': len(sys.stdin.readline())}), flush=True)"
    with start(program) as process:
        process.send({"text": "x" * 1_000_000}, PATIENCE_SECONDS)
        assert process.receive(PATIENCE_SECONDS)["n"] > 1_000_000


def test_sending_to_a_process_that_has_ended_is_noticed_at_receiving() -> None:
    with start("sys.exit(3)") as process:
        while process.alive:
            time.sleep(0.01)
        process.send({"n": 1}, PATIENCE_SECONDS)
        with pytest.raises(ProcessEndedError) as caught:
            process.receive(PATIENCE_SECONDS)
        assert caught.value.status == 3


def test_without_messages_standard_input_is_empty() -> None:
    program = "print(json.dumps({'read': sys.stdin.read(), 'place': os.readlink('/proc/self/fd/0')}), flush=True)"
    with start(program, takes_messages=False) as process:
        assert process.receive(PATIENCE_SECONDS) == {"read": "", "place": os.devnull}


# ---- errors and logs ----------------------------------------------------------------------------------


def test_a_flood_of_errors_holds_nothing_up_and_its_last_lines_are_kept() -> None:
    program = (
        "for n in range(100_000): print('line', n, file=sys.stderr)\n"
        "print('bar 1\\rbar 2', file=sys.stderr); print('y' * 10_000, file=sys.stderr)\n"
        "print(json.dumps({'done': True}), flush=True); sys.exit(4)"
    )
    with start(program) as process:
        assert process.receive(60) == {"done": True}
        assert len(process._recent) <= TAIL_LINES * TAIL_LINE_LENGTH
        with pytest.raises(ProcessEndedError) as caught:
            process.receive(PATIENCE_SECONDS)
    tail = caught.value.tail
    assert caught.value.status == 4
    assert len(tail) == TAIL_LINES
    assert tail[-3:] == ["line 99999", "bar 2", "y" * TAIL_LINE_LENGTH]


def test_what_is_printed_goes_to_the_log_and_messages_to_a_pipe_of_their_own(tmp_path: Path) -> None:
    program = (
        "print('{\"printed\": 1}'); print('warning', file=sys.stderr); sys.stdout.flush()\n"
        "os.write(int(sys.argv[1]), b'{\"fine\": 1}\\n'); time.sleep(600)"
    )
    with start(program, log=tmp_path / "log.txt") as process:
        assert process.receive(PATIENCE_SECONDS) == {"fine": 1}
        assert process.tail() == ['{"printed": 1}', "warning"]
    assert (tmp_path / "log.txt").read_text() == '{"printed": 1}\nwarning\n'
    assert process.tail() == ['{"printed": 1}', "warning"]


def test_the_tail_of_a_closed_process_stays() -> None:
    with start("print('the last words', file=sys.stderr)") as process:
        while process.alive:
            time.sleep(0.01)
    assert process.tail() == ["the last words"]


def test_the_process_gets_the_given_environment_and_folder(tmp_path: Path) -> None:
    program = "import json, os; print(json.dumps({'environment': dict(os.environ), 'folder': os.getcwd()}))"
    with JsonLineProcess([sys.executable, "-c", program], env={"A": "1"}, cwd=tmp_path) as process:
        found = process.receive(PATIENCE_SECONDS)
    assert found["environment"]["A"] == "1"
    assert not {"HOME", "PATH"} & set(found["environment"])
    assert Path(found["folder"]) == tmp_path


@pytest.mark.parametrize("program", ["/nowhere/program", "/etc/passwd"])
def test_a_program_that_does_not_start_leaves_nothing_open(program: str) -> None:
    with pytest.raises(OSError, match=program):
        JsonLineProcess([program], env={})


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

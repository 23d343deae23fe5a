"""Child processes that exchange JSON lines: real ones, which stammer, flood, hang and complain."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from specimap_core.sandbox.json_lines import (
    LINE_LIMIT,
    TAIL_LINE_LENGTH,
    TAIL_LINES,
    InvalidMessageError,
    JsonLineProcess,
    ProcessEndedError,
)
from tests.support.json_line_scene import PATIENCE_SECONDS, start

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc"),
    pytest.mark.usefixtures("descriptors"),
]


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

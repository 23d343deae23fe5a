"""The command line as a program sees it: exit status, events, and what happens when it is stopped or killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from specimap_core import __version__
from specimap_core.pipeline.outputs import Outputs
from specimap_core.report.model import Report
from tests.support.scenes import Finished, OnDisk, assert_same_result, read_corners, specimap

PROGRAM = [sys.executable, "-c", "from specimap_cli import main; main()"]


def started(small: OnDisk, out: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*PROGRAM, "run", "--photos", str(small.photos), "--cube", str(small.header), "--out", str(out), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "2"},
    )


def read_until(process: subprocess.Popen[str], stage: str, share: float) -> None:
    """Read events until a stage has come so far."""
    assert process.stdout is not None
    for line in process.stdout:
        event = json.loads(line)
        if event["event"] == "progress" and event["stage"] == stage and event["share"] >= share:
            return
    pytest.fail(f"the run ended before {stage} {share}: {process.stderr.read() if process.stderr else ''}")


def test_version_and_help() -> None:
    said = specimap("--version").out
    assert __version__ in said
    assert "For research use only. Not a medical device." in said
    assert "--photos" in specimap("run", "--help").out
    assert specimap("run").status == 2


def test_the_run_has_written_everything(finished: Finished, small: OnDisk) -> None:
    outputs = Outputs(finished.out)
    for path in (outputs.cloud, outputs.mesh, outputs.report, outputs.corners, outputs.cameras, outputs.preview):
        assert path.exists()
    assert not list(finished.out.glob(".*.tmp"))
    ids, corners = read_corners(finished.out)
    assert ids == small.truth.marker_ids.tolist()
    assert corners.shape == (4, 4, 3)
    assert Report.model_validate_json(outputs.report.read_text()).marker_ids == ids


def test_info_prints_the_report(finished: Finished, tmp_path: Path) -> None:
    words = specimap("info", finished.out)
    assert words.status == 0
    assert "2D corner error" in words.out
    answer = specimap("info", finished.out, "--json")
    assert Report.model_validate_json(answer.out) == Report.model_validate_json(
        (finished.out / "report.json").read_text()
    )
    assert specimap("info", tmp_path).status == 2
    (tmp_path / "report.json").write_text('{"half')
    broken = specimap("info", tmp_path, "--json")
    assert broken.status == 2
    assert broken.refusal["code"] == "not_found"


def test_export_says_what_it_wrote(finished: Finished, tmp_path: Path) -> None:
    target = tmp_path / "cloud.ply"
    answer = specimap("export", finished.out, "--format", "ply", "--target", target, "--json")
    assert answer.status == 0
    assert answer.events == [{"event": "exported", "path": str(target)}]
    assert target.stat().st_size > 1000
    assert specimap("export", tmp_path, "--format", "ply").status == 2
    assert specimap("export", finished.out, "--format", "docx").status == 2


def test_the_same_run_again_repeats_nothing(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    before = (out / "report.json").read_bytes()
    answer = specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--json")
    assert answer.status == 0
    report = answer.events[-1]["report"]
    assert isinstance(report, dict)
    assert report["reused_stages"] == ["reconstruct", "adjust", "render", "register"]
    assert (out / "report.json").read_bytes() == before


@pytest.mark.slow
def test_a_result_from_before_there_were_cameras_gets_them(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    (out / "cameras.json").unlink()
    answer = specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--json")
    assert answer.status == 0
    report = answer.events[-1]["report"]
    assert isinstance(report, dict)
    assert report["reused_stages"] == ["reconstruct", "adjust", "render"]
    assert (out / "cameras.json").read_bytes() == (finished.out / "cameras.json").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("r_pc", ["0.05", "1.0"])
def test_another_grid_repeats_stages_3_and_4_only(finished: Finished, small: OnDisk, tmp_path: Path, r_pc: str) -> None:
    out = finished.copy_to(tmp_path / "out")
    answer = specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--r-pc", r_pc, "--json")
    assert answer.status == 0
    report = answer.events[-1]["report"]
    assert isinstance(report, dict)
    assert report["reused_stages"] == ["reconstruct", "adjust"]
    assert report["settings"]["render"]["r_pc_mm"] == float(r_pc)
    assert 0.001 < report["corner_2d_mm"]["mean"] < 0.1


KILLED = [("reconstruct", 0.5, []), ("adjust", 0.3, ["reconstruct"]), ("register", 0.1, ["reconstruct", "adjust"])]


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "share", "kept"), KILLED)
def test_a_killed_run_goes_on_where_it_was(
    small: OnDisk, finished: Finished, tmp_path: Path, stage: str, share: float, kept: list[str]
) -> None:
    out = tmp_path / "out"
    process = started(small, out)
    read_until(process, stage, share)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    if stage != "register":  # killed so late, the results may just have appeared
        assert not (out / "report.json").exists()
    answer = specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--json")
    assert answer.status == 0
    report = answer.events[-1]["report"]
    assert isinstance(report, dict)
    assert report["reused_stages"][: len(kept)] == kept
    assert not list(out.glob(".*.tmp"))
    assert not list((out / "stages").glob(".*.tmp"))
    assert_same_result(out, finished.out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "stage", "share"),
    [(signal.SIGINT, "reconstruct", 0.3), (signal.SIGTERM, "adjust", 0.1), (signal.SIGINT, "register", 0.0)],
)
def test_a_stopped_run_says_so_in_time(
    small: OnDisk, tmp_path: Path, number: signal.Signals, stage: str, share: float
) -> None:
    process = started(small, tmp_path / "out")
    read_until(process, stage, share)
    start = time.monotonic()
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert time.monotonic() - start < 5
    if process.returncode == 0 and stage == "register":
        pytest.skip("the run was whole before it heard")
    assert process.returncode == 130
    last = json.loads(out.splitlines()[-1])
    assert last["event"] == "refused"
    assert last["code"] == "cancelled"
    assert "Traceback" not in err
    assert not (tmp_path / "out" / "report.json").exists()


def test_a_reader_that_goes_away_is_no_traceback(finished: Finished) -> None:
    process = subprocess.Popen(
        [*PROGRAM, "info", str(finished.out), "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert "Traceback" not in process.stderr.read()
    process.stderr.close()
    process.wait(20)

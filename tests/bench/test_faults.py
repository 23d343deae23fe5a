"""Jobs beside kills: what is counted, and that the stage that stands in is one to a worker."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from bench.faults.__main__ import STAND_IN
from bench.faults.run import percentiles
from bench.faults.sheet import newest_of_each, sheet_faults


def run(database: str, succeeded: int, **given: Any) -> dict[str, Any]:
    of_worker = percentiles([float(k) for k in range(1, 101)])
    return {
        "jobs": 10,
        "states": {"succeeded": succeeded, "failed": 10 - succeeded},
        "kills": {"worker": 3},
        "seconds": 90.0,
        "most_starts": 2,
        "takeovers": {"worker": of_worker, "machine": percentiles([7.0])},
        "real_stages": False,
        "machines": 1,
        "slots": 2,
        "hogs": 0,
        "database": database,
        **given,
    }


def test_percentiles_are_times_that_were_measured() -> None:
    assert percentiles([3.0, 1.0, 2.0]) == {"number": 3, "0.5": 2.0, "0.99": 3.0, "1": 3.0}
    assert percentiles([float(k) for k in range(1, 101)])["0.99"] == 99.0


def test_each_kind_of_run_has_its_newest_row_and_what_is_lost_shows() -> None:
    old, new, other = run("sqlite", 10), run("sqlite", 9), run("postgresql", 10, takeovers={}, hogs=2)
    records = newest_of_each({"figures": figures} for figures in (old, new, other))
    assert [record["figures"] for record in records] == [other, new]
    rows = sheet_faults([record["figures"] for record in records]).rows
    assert rows[0] == (
        *("PostgreSQL, stand-ins, 1 x 2 workers, beside 2 busy loops", "10", "10", "0", "3 worker", "1.5", "2"),
        *("-", "-", "-", "-"),
    )
    assert rows[1][1:4] == ("10", "9", "1")
    assert rows[1][7:] == ("100 of a worker", "50.0", "99.0", "100.0")
    assert rows[2] == (*[""] * 7, "1 of a machine", "7.0", "7.0", "7.0")


def test_the_stage_that_stands_in_leaves_what_the_next_looks_for(tmp_path: Path) -> None:
    result, out = tmp_path / "result", tmp_path / "out"
    (result / "cloud.zarr").mkdir(parents=True)
    (result / "cloud.zarr" / "zarr.json").write_text("{}")
    out.mkdir()

    def stage(name: str) -> list[dict[str, Any]]:
        spec = {"stage": name, "out": str(out), "keys": {name: "0123"}}
        # A worker adds the limit of memory and its process id.
        command = [sys.executable, "-I", "-S", str(STAND_IN), str(result), "0", "0", "1"]
        done = subprocess.run(
            command, input=json.dumps(spec) + "\n", capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]

    assert [event["event"] for event in stage("adjust")] == ["progress", "done"]
    assert (out / "stages" / "adjust-0123.npz").is_file()
    assert stage("register")[-1] == {"event": "done", "seconds": 0.0}
    assert (out / "cloud.zarr" / "zarr.json").read_text() == "{}"

"""The table of the runs with kills."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from bench.service.sheet import NONE, Sheet

KINDS = {"sqlite": "SQLite", "postgresql": "PostgreSQL"}
HEADINGS = (
    *("", "jobs", "succeeded", "lost", "kills", "minutes", "most starts"),
    *("takeovers", "p50 s", "p99 s", "longest s"),
)


def newest_of_each(records: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of records, the oldest first, the newest of each kind of run."""
    newest = {words_of(record["figures"]): record for record in records}
    return [newest[words] for words in sorted(newest)]


def sheet_faults(runs: Sequence[dict[str, Any]]) -> Sheet:
    """A row for each run, and below it one for each further kind of death that others took over from."""
    sheet = Sheet("Jobs over HTTP while processes are killed at random", HEADINGS)
    for run in runs:
        succeeded = run["states"].get("succeeded", 0)
        kills = ", ".join(f"{number} {what}" for what, number in sorted(run["kills"].items()))
        cells = [words_of(run), str(run["jobs"]), str(succeeded), str(run["jobs"] - succeeded), kills or "0"]
        cells += [f"{run['seconds'] / 60:.1f}", str(run["most_starts"])]
        for what, seconds in sorted(run["takeovers"].items(), reverse=True):
            times = [f"{seconds[quantile]:.1f}" for quantile in ("0.5", "0.99", "1")]
            sheet.rows.append((*cells, f"{seconds['number']} of a {what}", *times))
            cells = [""] * len(cells)
        if not run["takeovers"]:
            sheet.rows.append((*cells, *[NONE] * 4))
    sheet.notes.append(
        "A takeover: from the death of a worker, or of a machine that does not come back, to the next start of a job "
        "that ran there."
    )
    return sheet


def words_of(run: dict[str, Any]) -> str:
    """What distinguishes a run."""
    stages = "real stages" if run["real_stages"] else "stand-ins"
    words = f"{KINDS[run['database']]}, {stages}, {run['machines']} x {run['slots']} workers"
    return words + (f", beside {run['hogs']} busy loops" if run["hogs"] else "")

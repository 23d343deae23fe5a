"""``python -m bench.tables``: put the newest records into README.md and the pages of tables in docs/.

Each text goes between a pair of marks, ``<!-- mark -->`` and ``<!-- /mark -->``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.faults.sheet import newest_of_each, sheet_faults
from bench.features import sheet_features
from bench.growth import sheet_growth
from bench.machine import in_words
from bench.photos import sheet_photos
from bench.record import RESULTS
from bench.service.parts import PARTS, in_markdown
from bench.service.sheet import Sheet
from bench.sigma import sheet_sigma
from bench.steps import sheet_steps
from specimap_validation.page_marks import put

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
ACCURACY = ROOT / "docs" / "accuracy-tables.md"
BACKENDS = ROOT / "docs" / "backends-tables.md"
PERFORMANCE = ROOT / "docs" / "performance-tables.md"
SAMPLE = "sample"
REAL = "apple"
OF_RUNS: dict[str, Callable[[dict[str, Any]], list[Sheet]]] = {
    "steps": sheet_steps,
    "photos": sheet_photos,
    "growth": sheet_growth,
}
"""Parts of ``python -m bench`` whose tables stand in docs/performance-tables.md."""
FAULTS = "faults"
MARKS: dict[Path, tuple[str, ...]] = {
    README: ("accuracy",),
    ACCURACY: ("accuracy", REAL, "sigma", "budget"),
    BACKENDS: ("features",),
    PERFORMANCE: (*OF_RUNS, *PARTS, FAULTS),
}
"""The marks that each page holds."""


def newest(part: str) -> dict[str, Any]:
    """Figures of the newest record of ``part``. Raises FileNotFoundError where there is none."""
    figures: dict[str, Any] = newest_record(part)["figures"]
    return figures


def newest_record(part: str) -> dict[str, Any]:
    """The newest record of ``part``, with its machine and time. Raises FileNotFoundError where there is none."""
    records = sorted(RESULTS.glob(f"*-{part}.json"))
    if not records:
        raise FileNotFoundError(f"bench/results/ holds no record of {part}: run make bench, or make bench-service")
    record: dict[str, Any] = json.loads(records[-1].read_text(encoding="utf-8"))
    return record


def sample_sentences(figures: dict[str, Any]) -> str:
    """The error on the sample, by both registrations, for the README."""
    best, flat = figures[SAMPLE]["camera"], figures[SAMPLE]["homography"]
    return (
        f"On the synthetic sample the median position error is {best['median_mm']:.3f} mm, and 95 % of the specimen's "
        f"points lie within {best['p95_mm']:.2f} mm of the truth. The published registration (`--method homography`), "
        f"on the same photos, gives {flat['median_mm']:.2f} and {flat['p95_mm']:.2f} mm."
    )


def accuracy_table(figures: dict[str, Any]) -> str:
    """The errors of all acquisitions against truth, for docs/accuracy-tables.md."""
    rows = [
        "| acquisition | photos used | median mm | p95 mm | coverage | scale | 2D corner mm | 3D corner mm "
        "| `homography`: median, p95 mm |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, case in figures.items():
        if name == REAL:
            continue
        used, given = case["report"]["photos"]
        flat, best, output = case["homography"], case["camera"], case["report"]
        rows.append(
            f"| {name} | {used} of {given} | {best['median_mm']:.3f} | {best['p95_mm']:.3f} "
            f"| {100 * best['coverage']:.2f} % | {100 * best['scale']:+.2f} % | {output['corner_2d_mm']:.3f} "
            f"| {output['corner_3d_mm']:.3f} | {flat['median_mm']:.3f}, {flat['p95_mm']:.3f} |"
        )
    return "\n".join(rows)


def budget_table(figures: dict[str, Any]) -> str:
    """The error that is left when one part is replaced by truth, for docs/accuracy-tables.md."""
    names = list(figures)
    rows = [f"| what is true | {' | '.join(f'{n}: median, p95 mm' for n in names)} |", "|---|" + "---|" * len(names)]
    for parts in zip(*figures.values(), strict=True):
        rows.append(f"| {parts[0][0]} | {' | '.join(f'{median:.3f}, {p95:.3f}' for _, median, p95 in parts)} |")
    return "\n".join(rows)


def real_line(real: dict[str, Any]) -> str:
    """The result on the printed board, in one sentence."""
    (used, given), (mean, std) = real["photos"], real["edge_mm"]
    return (
        f"{used} of {given} photos used, {real['markers']} markers, printed edges {mean:.3f} mm on average, "
        f"standard deviation {100 * std / mean:.2f} %, corners {real['rms_px']:.2f} px RMS, mesh after "
        f"{real['seconds']:.0f} s."
    )


def run_tables(part: str, record: dict[str, Any]) -> str:
    """The tables of a kept record of one of ``OF_RUNS``, and the machine that they were measured on."""
    figures, machine = record["figures"], record["machine"]
    tables = [sheet.markdown() for sheet in OF_RUNS[part](figures)]
    return "\n\n".join([*tables, f"{in_words(machine)}, {figures['load_after']} after; {record['time'][:10]}."])


def faults_table() -> str:
    """Jobs while processes are killed: the newest record of each kind of run, and what it was measured on."""
    records = newest_of_each(json.loads(path.read_text("utf-8")) for path in sorted(RESULTS.glob(f"*-{FAULTS}.json")))
    places = {f"{in_words(record['machine'])}; {record['time'][:10]}." for record in records}
    return "\n\n".join([sheet_faults([record["figures"] for record in records]).markdown(), *sorted(places)])


def main() -> None:
    """Fill the pages."""
    figures = newest("accuracy")
    put(README, "accuracy", sample_sentences(figures))
    put(ACCURACY, "accuracy", accuracy_table(figures))
    if REAL in figures:
        put(ACCURACY, REAL, real_line(figures[REAL]))
    put(ACCURACY, "budget", budget_table(newest("budget")))
    put(ACCURACY, "sigma", sheet_sigma(newest("sigma")).markdown())
    put(BACKENDS, "features", sheet_features(newest("features")).markdown())
    for part in OF_RUNS:
        put(PERFORMANCE, part, run_tables(part, newest_record(part)))
    for part in PARTS:
        put(PERFORMANCE, part, in_markdown(part, newest_record(f"service-{part}")))
    put(PERFORMANCE, FAULTS, faults_table())


if __name__ == "__main__":
    main()

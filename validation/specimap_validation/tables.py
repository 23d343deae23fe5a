"""Tables of studies and validations as text: for a terminal, Markdown or HTML."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.report import published
from specimap_validation import validation as v
from specimap_validation.cases import MOVED
from specimap_validation.runs import Figures
from specimap_validation.subsampling import Row as StudyRow

NOTHING = "-"
LEAST_RANKED = 3
VERDICTS = ("trusted", "doubtful", "not_trusted")


@dataclass(frozen=True)
class Table:
    """``headings``, and ``rows`` of as many cells each."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Write the table in GitHub's Markdown."""
        lines = [f"| {' | '.join(row)} |" for row in (self.headings, *self.rows)]
        return "\n".join([lines[0], "|" + "---|" * len(self.headings), *lines[1:]])


# ---- subsampling --------------------------------------------------------------------------------------

STUDY_HEADINGS = (
    "share of photos",
    "seed",
    "photos used",
    "2D corner mm",
    "3D corner mm",
    "true error mm: median, p95",
    "coverage",
    "seconds",
)


def study_cells(row: StudyRow) -> tuple[str, ...]:
    """Return the cells of one run, in the order of the headings."""
    found = row.outcome.figures
    start = f"{row.share} %", str(row.seed)
    if found is None:
        code = row.outcome.refusal.code if row.outcome.refusal else NOTHING
        return (*start, f"0 of {row.photos}", code, *(NOTHING,) * 4)
    true = found.truth
    return (
        *start,
        f"{found.photos_used} of {row.photos}",
        f"{found.corner_2d_mm.mean:.3f} ± {found.corner_2d_mm.std:.3f}",
        _median(found),
        f"{true.median_mm:.3f}, {true.p95_mm:.2f}" if true else NOTHING,
        f"{100 * true.coverage:.1f} %" if true else NOTHING,
        f"{found.seconds:.1f}",
    )


def study_table(rows: Sequence[StudyRow]) -> Table:
    """Make the table of all runs of a study."""
    return Table("Every run", STUDY_HEADINGS, tuple(study_cells(row) for row in rows))


def _median(found: Figures) -> str:
    corners = found.corner_3d_mm
    return NOTHING if corners is None else f"{corners.median:.3f} ({corners.q1:.3f}-{corners.q3:.3f})"


# ---- validation ---------------------------------------------------------------------------------------

VALIDATION_HEADINGS = (
    "acquisition",
    "registration, adjustment",
    "2D corner mm: mean ± sd",
    "3D corner mm: median (quartiles)",
    "left-out marker mm",
    "true error mm: median",
    "true error mm: p95",
    "scale",
    "coverage",
    "within 1, 2 sigma",
    "certificate, mm seen",
    "warnings",
)


def pooled_cells(name: str, rows: Sequence[v.Row]) -> tuple[str, ...]:
    """Pool runs of one variant in one line: means of the reported figures, medians of the true errors, the worst in
    brackets, the least coverage."""
    method, form = rows[0].method, rows[0].adjustment
    found = [row.outcome.figures for row in rows if row.outcome.figures is not None]
    counts = Counter(row.outcome.refusal.code for row in rows if row.outcome.refusal is not None)
    refused = [f"{code} ({counts[code]} of {len(rows)})" for code in sorted(counts)]
    label = f"{name}, refused: {', '.join(refused)}" if refused else name
    if not found:
        return (label, f"{method}, {form}", *(NOTHING,) * 10)
    means = np.array([f.corner_2d_mm.mean for f in found])
    spread = float(np.sqrt(np.mean([f.corner_2d_mm.std**2 for f in found]) + means.var()))
    corners_3d = [f.corner_3d_mm for f in found if f.corner_3d_mm is not None]
    left_out = [f.leave_one_marker_out_mm for f in found if f.leave_one_marker_out_mm is not None]
    truth = [f.truth for f in found if f.truth is not None]
    quartiles = [np.median([getattr(d, k) for d in corners_3d]) for k in ("median", "q1", "q3")] if corners_3d else []
    scale = max((t.scale for t in truth), key=abs, default=float("nan"))
    return (
        label,
        f"{method}, {form}",
        f"{means.mean():.3f} ± {spread:.3f}",
        f"{quartiles[0]:.3f} ({quartiles[1]:.3f}-{quartiles[2]:.3f})" if corners_3d else NOTHING,
        f"{np.median(left_out):.3f}" if left_out else NOTHING,
        _with_worst([t.median_mm for t in truth], 3),
        _with_worst([t.p95_mm for t in truth], 2),
        f"{100 * scale:+.2f} %" if truth else NOTHING,
        f"{100 * min(t.coverage for t in truth):.1f} %" if truth else NOTHING,
        f"{_percent([t.within_1_sigma for t in truth])}, {_percent([t.within_2_sigma for t in truth])}",
        _certified(found),
        _warnings(found),
    )


def _certified(found: Sequence[Figures]) -> str:
    known = [f.certified for f in found if f.certified is not None]
    if not known:
        return NOTHING
    seen = [c.seen_median_mm for c in known if c.seen_median_mm is not None]
    worst = max((c.verdict for c in known), key=VERDICTS.index)
    return f"{worst.replace('_', ' ')}, {_with_worst(seen, 3) or NOTHING}"


def _warnings(found: Sequence[Figures]) -> str:
    counts = Counter(code for f in found for code in set(f.warnings))
    return ", ".join(f"{code} ({counts[code]} of {len(found)})" for code in sorted(counts)) or NOTHING


def _percent(shares: Sequence[float]) -> str:
    return f"{100 * np.mean(shares):.0f} %" if shares else NOTHING


def _with_worst(values: Sequence[float], digits: int) -> str:
    if not values:
        return NOTHING
    middle, worst = f"{np.median(values):.{digits}f}", f"{max(values):.{digits}f}"
    return middle if len(values) == 1 else f"{middle} [{worst}]"


def _published_cells() -> tuple[str, ...]:
    corners_2d = ", ".join(f"{mean:.3f} ± {sd:.3f}" for mean, sd in published.CORNER_2D_MM)
    corners_3d = ", ".join(f"{median:.3f}" for median in published.CORNER_3D_MM)
    return (f"{published.REFERENCE}, two specimens", "homography, free", corners_2d, corners_3d, *(NOTHING,) * 8)


def validation_tables(validation: v.Validation) -> list[Table]:
    """Make two tables: each acquisition by the default and the published form, and all four forms over all of them."""
    defects = list(dict.fromkeys(row.defect for row in validation.rows))
    by_case = [
        pooled_cells(defect, chosen)
        for defect in defects
        for variant in (v.DEFAULT, v.AS_PUBLISHED)
        if (chosen := _of(validation.rows, variant, defect))
    ]
    still = [row for row in validation.rows if row.defect != MOVED]
    whole = [
        pooled_cells(f"{len(chosen)} where nothing moved", chosen)
        for variant in v.VARIANTS
        if (chosen := _of(still, variant))
    ]
    return [
        Table("By acquisition", VALIDATION_HEADINGS, (_published_cells(), *by_case)),
        Table("By form of the method", VALIDATION_HEADINGS, tuple(whole)),
    ]


def _of(rows: Sequence[v.Row], variant: tuple[str, str], defect: str | None = None) -> list[v.Row]:
    return [r for r in rows if (r.method, r.adjustment) == variant and defect in (None, r.defect)]


def certificate_rank(validation: v.Validation) -> tuple[float, int] | None:
    """Spearman's correlation of the errors that the certificates of the default form saw with the true medians, and of
    how many runs; None for fewer than three."""
    pairs = [
        (found.certified.seen_median_mm, found.truth.median_mm)
        for row in validation.rows
        if (row.method, row.adjustment) == v.DEFAULT
        and (found := row.outcome.figures) is not None
        and found.truth is not None
        and found.certified is not None
        and found.certified.seen_median_mm is not None
    ]
    if len(pairs) < LEAST_RANKED:
        return None
    # Loaded here: studies of one acquisition need no statistics.
    from scipy.stats import spearmanr

    return float(spearmanr(*zip(*pairs, strict=True)).statistic), len(pairs)


def in_words(validation: v.Validation) -> str:
    """Describe the basis of the tables in a sentence or two."""
    seeds = sorted({row.seed for row in validation.rows if row.seed is not None})
    size = "quick, on small phantoms" if validation.quick else "on phantoms of full size"
    rank = certificate_rank(validation)
    ranked = f" The errors seen rank {rank[1]} runs as the true medians do: Spearman {rank[0]:.2f}." if rank else ""
    return (
        f"Specimap {validation.specimap_version}, {size}, seeds {', '.join(map(str, seeds)) or NOTHING}. Corner "
        "figures are means over the seeds, true errors medians over the seeds with the worst seed in brackets, "
        "scale the worst, coverage the least; the certificate's worst verdict, and the error that it sees as a median."
        f"{ranked}"
    )

"""Figures of studies and validations, with the published values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from specimap_core.report import published
from specimap_core.report.plotting import BLUE, GREEN, INK, MUTED, SMALL_PT, VERMILION, figure, styled
from specimap_validation import validation as v
from specimap_validation.runs import Figures
from specimap_validation.subsampling import Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMES = {v.DEFAULT: "camera, rigid (default)", v.AS_PUBLISHED: "homography, free (as published)"}
_COLOURS = {v.DEFAULT: BLUE, v.AS_PUBLISHED: VERMILION}
_NORMAL = {1: 68.3, 2: 95.4}
"""Percent of a normal distribution within one and two standard deviations."""


# ---- subsampling --------------------------------------------------------------------------------------


def study_2d(study: Study) -> Figure:
    """Draw the 2D corner error against the share of photos."""
    drawn = figure(height_in=3.4)
    ax = _share_axes(drawn, study, "2D corner error by share of the photos", "2D corner error, mm (mean of a run)")
    _series(ax, study, lambda f: f.corner_2d_mm.mean, BLUE, "o", "this method")
    for k, (mean, sd) in enumerate(published.CORNER_2D_MM):
        ax.errorbar(
            100 - 0.8 * (k + 1),
            mean,
            yerr=sd,
            color=VERMILION,
            marker="D",
            markersize=4,
            linewidth=1,
            capsize=2,
            linestyle="none",
            label=f"{published.REFERENCE}, two specimens, mean ± sd" if k == 0 else None,
        )
    ax.set_ylim(bottom=0)
    _legend_below(drawn, ax)
    return drawn


def study_3d(study: Study) -> Figure:
    """Draw the 3D corner error against the share of photos, and the true error where it is known."""
    drawn = figure(height_in=4.2)
    ax = _share_axes(drawn, study, "3D error by share of the photos", "error, mm (logarithmic)")
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    _series(ax, study, _corner_3d_median, BLUE, "o", "3D corner error, median")
    _series(ax, study, lambda f: f.truth.median_mm if f.truth else None, GREEN, "s", "true error, median")
    _series(ax, study, lambda f: f.truth.p95_mm if f.truth else None, GREEN, "^", "true error, 95th percentile")
    ax.plot(
        [99.2, 98.4],
        published.CORNER_3D_MM,
        color=VERMILION,
        marker="D",
        markersize=4,
        linestyle="none",
        label=f"{published.REFERENCE}: 3D corner error, median",
    )
    lowest = min((row.share for row in study.rows), default=50)
    ax.plot(
        [published.DROPPED_SHARE, min(lowest, published.DROPPED_SHARE - 2)],
        [published.DROPPED_3D_MM] * 2,
        color=VERMILION,
        linewidth=1.2,
        linestyle="--",
        marker="^",
        markersize=5,
        markevery=[0],
        label=f"{published.REFERENCE}: above {published.DROPPED_3D_MM:g} mm from {published.DROPPED_SHARE} % on",
    )
    _legend_below(drawn, ax)
    return drawn


def _share_axes(drawn: Figure, study: Study, title: str, y: str) -> Axes:
    ax = styled(drawn.add_subplot(), title=title, x=f"share of the {study.photos} photos, %", y=y)
    shares = [row.share for row in study.rows] or [100]
    ax.set_xlim(103, min(shares) - 3)
    ax.set_xticks(sorted(set(shares)))
    refused = sorted({row.share for row in study.rows if row.outcome.figures is None}, reverse=True)
    for share in refused:
        count = sum(row.share == share and row.outcome.figures is None for row in study.rows)
        ax.text(
            share,
            0.02,
            f"{count} refused",
            transform=ax.get_xaxis_transform(),
            ha="center",
            fontsize=SMALL_PT,
            color=MUTED,
            rotation=90,
            va="bottom",
        )
    return ax


def _series(
    ax: Axes, study: Study, value: Callable[[Figures], float | None], colour: str, marker: str, label: str
) -> None:
    """Draw a dot for each run, and a line through the medians."""
    known = [
        (row.share, number)
        for row in study.rows
        if row.outcome.figures is not None and (number := value(row.outcome.figures)) is not None
    ]
    if not known:
        return
    ax.plot([s for s, _ in known], [n for _, n in known], marker, color=colour, markersize=3.5, alpha=0.55)
    shares = sorted({s for s, _ in known}, reverse=True)
    middles = [float(np.median([n for s, n in known if s == share])) for share in shares]
    ax.plot(shares, middles, color=colour, marker=marker, markersize=4.5, linewidth=1.4, label=label)


def _corner_3d_median(found: Figures) -> float | None:
    return None if found.corner_3d_mm is None else found.corner_3d_mm.median


# ---- validation ---------------------------------------------------------------------------------------


def validation_error(validation: v.Validation) -> Figure:
    """Draw the true error of each acquisition: median and 95th percentile, by the default and by the published form."""
    names = _names(validation.rows)
    drawn = figure(height_in=1.7 + 0.34 * len(names))
    ax = styled(
        drawn.add_subplot(), title="True error on the specimen", x="mm: median (dot) to 95th percentile, a line a run"
    )
    for variant, colour in _COLOURS.items():
        label: str | None = _NAMES[variant]
        for row in _of(validation, variant):
            true = row.outcome.figures.truth if row.outcome.figures else None
            if true is None:
                continue
            y = names.index(row.defect) + (-0.15 if variant == v.DEFAULT else 0.15) + 0.05 * ((row.seed or 2) - 2)
            ax.plot([true.median_mm, true.p95_mm], [y, y], color=colour, linewidth=1.2, alpha=0.6)
            ax.plot([true.median_mm], [y], "o", color=colour, markersize=4, label=label)
            label = None
    _logarithmic(ax)
    _list_acquisitions(ax, names)
    _legend_below(drawn, ax)
    return drawn


def validation_corners(validation: v.Validation) -> Figure:
    """Draw corner errors of each acquisition, and the published ones."""
    names = _names(validation.rows)
    drawn = figure(height_in=1.7 + 0.3 * len(names))
    ax_2d, ax_3d = drawn.subplots(1, 2, sharey=True)
    styled(ax_2d, title="2D corner error", x="mm, mean of a run")
    styled(ax_3d, title="3D corner error", x="mm, median of a run")
    for variant, colour in _COLOURS.items():
        label: str | None = _NAMES[variant]
        for row in _of(validation, variant):
            found = row.outcome.figures
            if found is None:
                continue
            y = names.index(row.defect) + (-0.12 if variant == v.DEFAULT else 0.12)
            ax_2d.plot([found.corner_2d_mm.mean], [y], "o", color=colour, markersize=4, alpha=0.7, label=label)
            if found.corner_3d_mm is not None:
                ax_3d.plot([found.corner_3d_mm.median], [y], "o", color=colour, markersize=4, alpha=0.7)
            label = None
    for ax, values in ((ax_2d, [mean for mean, _ in published.CORNER_2D_MM]), (ax_3d, published.CORNER_3D_MM)):
        for k, value in enumerate(values):
            ax.axvline(value, color=INK, linewidth=1, linestyle="--", label=published.REFERENCE if k == 0 else None)
        _logarithmic(ax)
    _list_acquisitions(ax_2d, names)
    _legend_below(drawn, ax_2d)
    return drawn


def validation_sigma(validation: v.Validation) -> Figure:
    """Draw the share of the true errors within one and two stated standard deviations."""
    names = _names(validation.rows)
    drawn = figure(height_in=1.7 + 0.3 * len(names))
    ax = styled(
        drawn.add_subplot(),
        title="Stated standard deviation against true errors (default form)",
        x="% of the specimen's points",
    )
    for sigmas, colour in ((1, BLUE), (2, GREEN)):
        ax.axvline(_NORMAL[sigmas], color=colour, linewidth=1, linestyle="--")
        label: str | None = f"within {sigmas} sigma (dashed: normal distribution, {_NORMAL[sigmas]:.0f} %)"
        for row in _of(validation, v.DEFAULT):
            true = row.outcome.figures.truth if row.outcome.figures else None
            if true is None:
                continue
            share = 100 * (true.within_1_sigma if sigmas == 1 else true.within_2_sigma)
            ax.plot([share], [names.index(row.defect)], "o", color=colour, markersize=4, alpha=0.7, label=label)
            label = None
    ax.set_xlim(-1, 101)
    _list_acquisitions(ax, names)
    _legend_below(drawn, ax)
    return drawn


def _list_acquisitions(ax: Axes, names: list[str]) -> None:
    """List the acquisitions from top to bottom."""
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.5, -0.5)


def _logarithmic(ax: Axes) -> None:
    """Make the x axis logarithmic, labelled with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    ax.set_xscale("log")
    low, high = ax.get_xlim()
    # Within one decade the axis would show a single number.
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high / low > 30 else (1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())


def _legend_below(drawn: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=SMALL_PT, frameon=False, labelcolor=INK)


def _names(rows: Sequence[v.Row]) -> list[str]:
    return list(dict.fromkeys(row.defect for row in rows))


def _of(validation: v.Validation, variant: tuple[str, str]) -> list[v.Row]:
    return [row for row in validation.rows if (row.method, row.adjustment) == variant]

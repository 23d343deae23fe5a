"""Figures of the result: where there are points, what they look like, how high they lie, how sure they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes
from specimap_core.cloud import Cloud, Flag
from specimap_core.report import plotting as p
from specimap_core.report.maps import CubeFrame, TopRaster
from specimap_core.report.model import CubeCorners
from specimap_core.report.photo_figures import corners_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from specimap_core.truth.judge import Judged

MOST_HIGH_IN = 5.3
KINDS = (
    (Flag.GRAZING, "grazing, over 70 degrees", p.ORANGE),
    (Flag.DEPTH_INTERPOLATED, "depth interpolated", p.BLUE),
    (Flag.SATURATED, "spectrum saturated", p.PURPLE),
    (Flag.NO_DATA, "no value in some band", p.BLACK),
    (Flag.OCCLUDED, "occluded", p.VERMILION),
)
"""Flags that make a point doubtful, the gravest last; names for the legend."""
EMPTY, OTHER, SPECIMEN = "#505050", "#dcdcdc", "#a9c9b4"
NORMAL_WITHIN = ((1.0, 0.683), (2.0, 0.954), (3.0, 0.997))
"""Share of a normal distribution within k standard deviations."""


def on_specimen(cloud: Cloud) -> NDArray[np.bool_]:
    """Points (S,) of the specimen; all of them where none is flagged so."""
    found = (cloud.flags & Flag.SPECIMEN) > 0
    return found if found.any() else np.ones(cloud.n_points, bool)


def draw_coverage(cloud: Cloud, frame: CubeFrame, corners: CubeCorners | None) -> Figure:
    """Which of the cube's pixels have a point, and what of."""
    kinds = 1 + ((cloud.flags & Flag.MARKER_CARD) > 0) + 2 * ((cloud.flags & Flag.SPECIMEN) > 0)
    found = frame.highest(np.minimum(kinds, 3).astype(np.uint8))
    colours = (EMPTY, OTHER, p.SKY, p.GREEN)
    names = ("no point", "surroundings", "marker card", "specimen")
    figure, ax = _in_cube(frame, "Pixels of the cube that have a point")
    _classes(ax, found, colours, names)
    if corners is not None and corners.marker_ids:
        import cv2

        hull = cv2.convexHull(corners_of(corners)[0].reshape(-1, 2).astype(np.float32))[:, 0] / frame.step
        ax.plot(*np.vstack([hull, hull[:1]]).T, color="white", linewidth=2.4)
        ax.plot(*np.vstack([hull, hull[:1]]).T, color=p.VERMILION, linewidth=1.2, label="between the markers")
    p.legend_below(figure, columns=3)
    p.scale_bar(ax, 1 / frame.mm_per_px, frame.cols)
    return figure


def draw_flags(cloud: Cloud, frame: CubeFrame) -> Figure:
    """Points that are doubtful, and why; the gravest reason of each pixel."""
    specimen = (cloud.flags & Flag.SPECIMEN) > 0
    kinds = np.where(specimen, 2, 1).astype(np.uint8)
    names, colours = ["no point", "surroundings", "specimen, no doubt"], ["white", OTHER, SPECIMEN]
    for value, (flag, name, colour) in enumerate(KINDS, start=3):
        flagged = (cloud.flags & flag) > 0
        kinds[flagged] = value
        share = 100 * float((flagged & specimen).sum()) / max(int(specimen.sum()), 1)
        names.append(f"{name}: {share:.1f} %")
        colours.append(colour)
    figure, ax = _in_cube(frame, "Doubtful points")
    _classes(ax, frame.highest(kinds), colours, names)
    p.legend_below(figure, columns=3)
    p.scale_bar(ax, 1 / frame.mm_per_px, frame.cols)
    return figure


def draw_above(above: TopRaster, preview: Bytes | None) -> Figure:
    """The photos' colours on the surface, and next to them the first three principal components of the spectra."""
    wide = p.WIDTH_IN / (2 if preview is not None else 1.6)
    figure = p.figure(p.WIDTH_IN if preview is not None else wide, wide * _ratio(above) + 0.35)
    panels = figure.subplots(1, 2 if preview is not None else 1, squeeze=False)[0]
    p.bare(panels[0], title="Colour, from the photos")
    panels[0].imshow(above.rgb, origin="lower", interpolation="antialiased")
    p.scale_bar(panels[0], 1 / above.grid_mm, above.rgb.shape[1])
    if preview is not None:
        p.bare(panels[1], title="Spectra, first three principal components")
        panels[1].imshow(preview, interpolation="antialiased")
    return figure


def draw_height(above: TopRaster) -> Figure:
    """The height over the marker plane, with millimetres on all axes."""
    figure = p.figure(p.WIDTH_IN * 0.85, min(MOST_HIGH_IN, p.WIDTH_IN * 0.68 * _ratio(above) + 0.5))
    ax = p.styled(figure.add_subplot(), title="Height over the marker plane", x="x, mm", y="y, mm", grid=False)
    low, high = p.limits(above.height_mm, (0.5, 99.5))
    shown = ax.imshow(
        above.height_mm, origin="lower", extent=above.extent_mm, cmap=p.colour_map(p.HEIGHTS), vmin=low, vmax=high
    )
    if high - low > 2:
        rows, cols = above.height_mm.shape
        x = np.linspace(*above.extent_mm[:2], cols)
        y = np.linspace(*above.extent_mm[2:], rows)
        levels = np.arange(np.ceil(low / 2) * 2, high, 2)[1:]
        if levels.size:
            ax.contour(x, y, above.height_mm, levels=levels, colors="white", linewidths=0.4)
    p.scale_bar(ax, 1.0, above.extent_mm[1] - above.extent_mm[0])
    p.colour_bar(figure, ax, shown, "height, mm", extend="both")
    return figure


def draw_sigma(cloud: Cloud, frame: CubeFrame) -> Figure:
    """The stated standard deviation of each point's place, as the cube saw it."""
    figure, ax = _in_cube(frame, "Stated standard deviation of the position")
    chosen = cloud.sigma_mm[on_specimen(cloud)]
    shown = ax.imshow(
        frame.mean(cloud.sigma_mm),
        cmap=p.colour_map(p.ERRORS),
        vmin=0,
        vmax=p.limits(chosen, (0, 98))[1],
        interpolation="nearest",
    )
    p.scale_bar(ax, 1 / frame.mm_per_px, frame.cols)
    p.colour_bar(figure, ax, shown, "sigma, mm", extend="max")
    return figure


def draw_sigma_histogram(cloud: Cloud) -> Figure:
    """How the stated standard deviations of the specimen's points are spread."""
    sigma = cloud.sigma_mm[on_specimen(cloud)]
    figure = p.figure(p.WIDTH_IN, 2.7)
    ax = p.styled(figure.add_subplot(), title="Specimen", x="sigma, mm", y="points")
    finite = sigma[np.isfinite(sigma)]
    if finite.size:
        top = p.limits(finite, (0, 99.5))[1]
        ax.hist(finite, bins=60, range=(0, top), color=p.BLUE)
        for share, colour in ((50, p.VERMILION), (95, p.ORANGE)):
            at = float(np.percentile(finite, share))
            ax.axvline(at, color=colour, linewidth=1.6, label=f"{share} % of the points below {at:.3f} mm")
        ax.set_xlim(0, top)
        p.legend(ax)
    return figure


def draw_error_map(errors: Judged, frame: CubeFrame) -> Figure:
    """The distance of each point of the specimen from where its pixel truly looked."""
    figure, ax = _in_cube(frame, "Error of the position against truth")
    shown = ax.imshow(
        frame.mean(errors.errors_mm, errors.points),
        cmap=p.colour_map(p.ERRORS),
        vmin=0,
        vmax=p.limits(errors.errors_mm, (0, 98))[1],
        interpolation="nearest",
    )
    p.scale_bar(ax, 1 / frame.mm_per_px, frame.cols)
    p.colour_bar(figure, ax, shown, "error, mm", extend="max")
    return figure


def draw_reliability(errors: Judged) -> Figure:
    """How the errors are spread, and what share of them lies within k stated standard deviations."""
    figure = p.figure(p.WIDTH_IN, 3.1)
    spread, within = figure.subplots(1, 2)
    p.styled(spread, title="Errors of the specimen's points", x="error, mm", y="share of the points")
    top = p.limits(errors.errors_mm, (0, 99))[1]
    shares = np.arange(1, len(errors.errors_mm) + 1) / max(len(errors.errors_mm), 1)
    every = max(1, len(shares) // 1000)
    spread.plot(np.sort(errors.errors_mm)[::every], shares[::every], color=p.BLUE, linewidth=1.8)
    spread.set_xlim(0, top)
    spread.set_ylim(0, 1.02)
    k = np.linspace(0, 4, 81)
    p.styled(within, title="Are the stated sigmas right?", x="k", y="share of errors within k sigma")
    within.plot(k, [errors.within(v) for v in k.tolist()], color=p.BLUE, linewidth=1.8, label="this run")
    within.plot(
        *zip(*NORMAL_WITHIN, strict=True),
        color=p.VERMILION,
        marker="o",
        markersize=5,
        linestyle="none",
        label="normal distribution",
    )
    within.set_xlim(0, 4)
    within.set_ylim(0, 1.02)
    p.legend(within, place="lower right")
    return figure


def _ratio(above: TopRaster) -> float:
    return float(above.height_mm.shape[0] / above.height_mm.shape[1])


def _in_cube(frame: CubeFrame, title: str) -> tuple[Figure, Axes]:
    wide = p.WIDTH_IN * 0.85
    figure = p.figure(wide, min(MOST_HIGH_IN, wide * 0.84 * frame.rows / frame.cols + 0.4))
    ax = p.bare(figure.add_subplot(), title=title)
    ax.set_anchor("W")
    return figure, ax


def _classes(
    ax: Axes, found: NDArray[np.uint8], colours: tuple[str, ...] | list[str], names: tuple[str, ...] | list[str]
) -> None:
    """Classes as colours, those that occur named."""
    from matplotlib.colors import to_rgb

    table = np.rint(255 * np.array([to_rgb(c) for c in colours])).astype(np.uint8)
    ax.imshow(table[found], interpolation="nearest")
    occurring = np.bincount(found.ravel(), minlength=len(colours)) > 0
    for there, colour, name in zip(occurring, colours, names, strict=True):
        if there:
            ax.plot(
                [],
                [],
                marker="s",
                linestyle="none",
                markersize=7,
                color=colour,
                label=name,
                markeredgecolor=p.MUTED,
                markeredgewidth=0.4,
            )

"""Figures of the marker corners: in the photos, in the cube, and marker by marker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from specimap_core.arrays import Bytes, Floats
from specimap_core.register.figures import MethodFigures
from specimap_core.report import plotting as p
from specimap_core.report.model import CubeCorners, PhotoCorners

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 5
PAGE_IN = 9.0
"""Most height of a figure that shares a page with its caption."""
GAP_PX = 16
HEAD_PX = 34
"""Room above a tile for its number, in pixels of the tile."""
ARROW_SHARE = 0.06
"""An arrow of the 95th percentile is this share of the picture's width long."""
LIMIT_MM = 0.1
"""Leaving a marker out should show less than this; docs/surgeon-imaging.md."""


def corners_of(photo: PhotoCorners | CubeCorners) -> tuple[Floats, Floats]:
    """Corners and residuals (M, 4, 2), pixels."""
    corners = np.array(photo.corners_px, float).reshape(-1, 4, 2)
    return corners, np.array(photo.residuals_px, float).reshape(-1, 4, 2)


def lengths_of(photo: PhotoCorners | CubeCorners) -> Floats:
    """Lengths of the residuals (4 M,), pixels."""
    return np.asarray(np.linalg.norm(corners_of(photo)[1].reshape(-1, 2), axis=1))


def exaggeration(lengths: Floats, width_px: float) -> float:
    """A round factor (1, 2, 5, 10, ...) by which residuals of a picture of ``width_px`` become visible arrows."""
    finite = lengths[np.isfinite(lengths) & (lengths > 0)]
    if not finite.size:
        return 1.0
    wanted = ARROW_SHARE * width_px / float(np.percentile(finite, 95))
    step = 10.0 ** np.floor(np.log10(max(wanted, 1.0)))
    return float(max(m * step for m in (1, 2, 5) if m * step <= max(wanted, 1.0)))


def photos_a_sheet(photo: PhotoCorners) -> int:
    """How many photos of this shape one figure holds."""
    wide = p.WIDTH_IN / COLUMNS
    return COLUMNS * max(1, int(PAGE_IN / (wide * (photo.height_px / photo.width_px + 0.15))))


def draw_photos(photos: Sequence[PhotoCorners], tiles: Sequence[Bytes], first: int, factor: float) -> Figure:
    """Photos with their markers outlined and residuals as arrows, ``factor`` times too long; numbers from ``first``.

    Without ``tiles`` the outlines stand on grey.
    """
    from matplotlib.collections import PolyCollection

    rows = -(-len(photos) // COLUMNS)
    tile_w, tile_h = _tile_size(photos[0], tiles)
    step_x, step_y = tile_w + GAP_PX, tile_h + HEAD_PX
    canvas = np.full((rows * step_y, COLUMNS * step_x - GAP_PX, 3), 255, np.uint8)
    outlines: list[Floats] = []
    starts: list[Floats] = []
    arrows: list[Floats] = []
    ratio = canvas.shape[0] / canvas.shape[1]
    figure = p.figure(p.WIDTH_IN, p.WIDTH_IN * ratio)
    figure.set_layout_engine("none")
    ax = p.bare(figure.add_axes((0, 0, 1, 1)))
    for k, photo in enumerate(photos):
        x, y = (k % COLUMNS) * step_x, (k // COLUMNS) * step_y + HEAD_PX
        canvas[y : y + tile_h, x : x + tile_w] = tiles[k] if tiles else 225
        scale = tile_w / photo.width_px
        corners, residuals = corners_of(photo)
        placed = (corners + 0.5) * scale - 0.5 + [x, y]
        outlines.extend(placed)
        starts.append(placed.reshape(-1, 2))
        arrows.append(residuals.reshape(-1, 2) * scale * factor)
        # Numbers, not names: whatever a photo is called, its name stands in the table only.
        ax.text(x, y - 6, f"{first + k}", fontsize=p.FONT_PT, color=p.INK, ha="left", va="bottom", fontweight="bold")
        label = f"{len(photo.marker_ids)} markers, {_rms(photo):.2f} px" if photo.marker_ids else "no marker"
        ax.text(x + tile_w, y - 6, label, fontsize=p.SMALL_PT, color=p.MUTED, ha="right", va="bottom")
    ax.imshow(canvas, interpolation="antialiased")
    ax.add_collection(PolyCollection(outlines, facecolor="none", edgecolor="white", linewidth=2.0))
    ax.add_collection(PolyCollection(outlines, facecolor="none", edgecolor=p.BLUE, linewidth=1.1))
    _arrows(ax, np.concatenate(starts), np.concatenate(arrows))
    ax.set_xlim(-0.5, canvas.shape[1] - 0.5)
    ax.set_ylim(canvas.shape[0] - 0.5, -0.5)
    return figure


def draw_residuals(photos: Sequence[PhotoCorners], factor: float) -> Figure:
    """All photos' residuals in the image plane, their lengths, and their RMS photo by photo."""
    figure = p.figure(p.WIDTH_IN, 5.2)
    from matplotlib.ticker import MaxNLocator

    axes = figure.subplot_mosaic("AB;CC", height_ratios=(1.9, 1))
    plane, lengths_ax, by_photo = axes["A"], axes["B"], axes["C"]
    wide, high = photos[0].width_px, photos[0].height_px
    pairs = [corners_of(photo) for photo in photos if photo.marker_ids]
    starts = np.concatenate([c.reshape(-1, 2) for c, _ in pairs]) if pairs else np.empty((0, 2))
    residuals = np.concatenate([r.reshape(-1, 2) for _, r in pairs]) if pairs else np.empty((0, 2))
    p.styled(plane, title="All residuals in the image plane", x="x, px", y="y, px", grid=False)
    _arrows(plane, starts, residuals * factor)
    plane.set_xlim(0, wide)
    plane.set_ylim(high, 0)
    plane.set_aspect("equal")
    lengths = np.linalg.norm(residuals, axis=1)
    p.styled(lengths_ax, title="Their lengths", x="residual, px", y="corners")
    if lengths.size:
        lengths_ax.hist(lengths, bins=40, range=(0, p.limits(lengths, (0, 99.5))[1]), color=p.BLUE)
        lengths_ax.axvline(float(np.median(lengths)), color=p.VERMILION, linewidth=1.4, label="median")
        p.legend(lengths_ax)
    p.styled(by_photo, title="RMS of each photo", x="photo", y="RMS, px")
    by_photo.bar(np.arange(len(photos)) + 1, [_rms(photo) for photo in photos], color=p.BLUE, width=0.7)
    by_photo.set_xlim(0.3, len(photos) + 0.7)
    by_photo.xaxis.set_major_locator(MaxNLocator(integer=True))
    by_photo.grid(False, axis="x")
    return figure


def draw_cube_corners(cube: CubeCorners, factor: float) -> Figure:
    """The markers as the cube shows them, with the residuals of its solved camera."""
    from matplotlib.collections import PolyCollection

    figure = p.figure(p.WIDTH_IN * 0.62, 3.6)
    ax = p.styled(figure.add_subplot(), title="Corners in the cube", x="column, px", y="row, px", grid=False)
    corners, residuals = corners_of(cube)
    ax.add_collection(PolyCollection(list(corners), facecolor="#eeeeee", edgecolor=p.BLUE, linewidth=1.1))
    for marker_id, square in zip(cube.marker_ids, corners, strict=True):
        x, y = square.mean(0)
        ax.text(x, y, f"{marker_id}", ha="center", va="center", fontsize=p.FONT_PT, color=p.INK)
    _arrows(ax, corners.reshape(-1, 2), residuals.reshape(-1, 2) * factor)
    ax.set_xlim(0, cube.cols)
    ax.set_ylim(cube.rows, 0)
    ax.set_aspect("equal")
    return figure


def draw_left_out(methods: dict[str, MethodFigures]) -> Figure:
    """Mean error at each marker where the registration was fitted without it, method by method."""
    found = {name: m.leave_one_marker_out_mm for name, m in methods.items()}
    left = {name: loo.per_marker for name, loo in found.items() if loo is not None}
    ids = sorted({i for errors in left.values() for i in errors}, key=lambda i: (len(i), i))
    figure = p.figure(p.WIDTH_IN, 2.9)
    ax = p.styled(figure.add_subplot(), title="Error at a marker that was left out", x="marker", y="mean error, mm")
    wide = 0.8 / max(len(left), 1)
    for k, (name, errors) in enumerate(left.items()):
        at = np.arange(len(ids)) - 0.4 + (k + 0.5) * wide
        ax.bar(at, [errors.get(i, np.nan) for i in ids], width=wide * 0.92, color=p.PALETTE[k], label=name)
    highest = max((e for errors in left.values() for e in errors.values()), default=0.0)
    # Far below the limit, the line would only flatten the bars.
    if highest > LIMIT_MM / 4:
        ax.axhline(LIMIT_MM, color=p.INK, linewidth=1, linestyle="--", label=f"limit, {LIMIT_MM:g} mm")
    ax.set_xticks(np.arange(len(ids)), ids)
    ax.grid(False, axis="x")
    p.legend_below(figure)
    return figure


def _tile_size(photo: PhotoCorners, tiles: Sequence[Bytes]) -> tuple[int, int]:
    if tiles:
        return tiles[0].shape[1], tiles[0].shape[0]
    return 256, max(1, round(256 * photo.height_px / photo.width_px))


def _rms(photo: PhotoCorners) -> float:
    lengths = lengths_of(photo)
    return float(np.sqrt((lengths**2).mean())) if lengths.size else float("nan")


def _arrows(ax: Axes, starts: Floats, arrows: Floats) -> None:
    if len(starts):
        ax.quiver(
            starts[:, 0],
            starts[:, 1],
            arrows[:, 0],
            arrows[:, 1],
            angles="xy",
            scale_units="xy",
            scale=1,
            color=p.VERMILION,
            width=0.0022,
            headwidth=3.4,
            headlength=4,
            headaxislength=3.6,
            minlength=0.3,
            zorder=5,
        )

"""Pictures of a cloud as PNG, transparent where there is no point: in the cube's pixels, or seen from above in mm."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from cmap import Colormap
from numpy.typing import NDArray
from PIL import Image

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud
from specimap_core.cloud.top_view import extent_mm, top_view
from specimap_core.errors import NotFoundError
from specimap_service.errors import RequestInvalidError

Grid = Literal["cube", "marker"]
LARGEST_SIDE = 2048
STRETCH_PERCENT = (2.0, 98.0)
COLOUR_MAP = "viridis"
DIM = 0.35
"""Brightness of the grey photos under a label's colour, and where a point has no label."""
BAND = re.compile(r"^(?:(\d{1,5})|(\d{1,5}(?:\.\d{1,4})?)nm)$")
_PITCH_CELLS = 1.5
# Noise hardly compresses better at a higher level, which takes three times as long.
_COMPRESSION = 2


@dataclass(frozen=True, eq=False)
class PointColours:
    """Colours of all points: ``colours`` (S, 3) or grey (S,) uint8; ``shown`` (S,) False where it has none.

    ``range``: the values at the ends of the colour scale.
    """

    colours: NDArray[np.uint8]
    shown: NDArray[np.bool_] | None = None
    range: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """A PNG; ``range`` as of :class:`PointColours`; ``extent_mm``: x_min, y_min, x_max, y_max of its outer edges in the
    marker frame, where it is a view from above."""

    png: bytes
    range: tuple[float, float] | None
    extent_mm: tuple[float, float, float, float] | None


# ---- colours of points --------------------------------------------------------------------------------


def band_index(cloud: Cloud, given: str) -> int:
    """Return the band of an index (``120``) or a wavelength (``640nm``, the nearest band).

    Raises:
        RequestInvalidError: it is neither.
        NotFoundError: the cloud has no such band: the index is too large, the wavelength outside of its range.
    """
    found = BAND.match(given)
    if found is None:
        raise RequestInvalidError(f"{given[:20]!r} is no band.", advice="Give an index, or a wavelength as 640nm.")
    if found[1] is not None:
        index = int(found[1])
        if index >= cloud.bands:
            raise NotFoundError(f"There is no band {index}.", advice=f"Give 0 to {cloud.bands - 1}.", bands=cloud.bands)
        return index
    wanted, known = float(found[2]), cloud.wavelengths_nm
    if not np.isfinite(known).all():
        raise NotFoundError("The cloud's wavelengths are not known.", advice="Give band indices.", bands=cloud.bands)
    low, high = float(known.min()), float(known.max())
    step = (high - low) / max(cloud.bands - 1, 1)
    if not low - step <= wanted <= high + step:
        raise NotFoundError(
            f"There is no band at {wanted:g} nm.", advice=f"Give {low:g} to {high:g} nm.", wavelength_nm=[low, high]
        )
    return int(np.abs(known - wanted).argmin())


def paint_rgb(cloud: Cloud) -> PointColours:
    """Colour points as the photos do."""
    return PointColours(cloud.rgb)


def paint_band(cloud: Cloud, band: int, limits: tuple[float, float] | None) -> PointColours:
    """Show one band in grey, between ``limits`` or its own percentiles; points without a value are not shown."""
    values = cloud.band_values([band])[:, 0]
    limits = limits or _percentiles(values)
    return PointColours(_levels(values, limits), _known(values), limits)


def paint_composite(cloud: Cloud, bands: tuple[int, int, int]) -> PointColours:
    """Show three bands as red, green and blue, each between its own percentiles; points that lack one are not shown."""
    values = cloud.band_values(list(bands))
    channels = [_levels(values[:, i], _percentiles(values[:, i])) for i in range(3)]
    return PointColours(np.stack(channels, 1), _known(values.sum(1)))


def paint_index(cloud: Cloud, a: int, b: int, limits: tuple[float, float] | None) -> PointColours:
    """Show (a - b) / (a + b) of two bands as a colour scale; points where a + b is not positive are not shown."""
    values = cloud.band_values([a, b]).astype(np.float64)
    total = values.sum(1)
    shown = total > 0  # False for NaN, too
    index = np.divide(values[:, 0] - values[:, 1], total, out=np.zeros(len(total)), where=shown)
    limits = limits or _percentiles(index[shown])
    return PointColours(_scale()[_levels(index, limits)], shown, limits)


def paint_pca(cloud: Cloud, preview: bytes) -> PointColours:
    """Look every point up in the run's own ``preview.png``, a view from above in principal components."""
    with Image.open(io.BytesIO(preview)) as image:
        pixels = np.asarray(image.convert("RGBA"))
    x_min, y_min, x_max, y_max = extent_mm(cloud)
    rows, cols = pixels.shape[:2]
    # The preview's edges are the cloud's, to half a pixel; it is filled two pixels beyond any point.
    col = np.rint((cloud.xyz[:, 0] - x_min) * ((cols - 1) / max(x_max - x_min, 1e-9))).astype(np.intp)
    row = rows - 1 - np.rint((cloud.xyz[:, 1] - y_min) * ((rows - 1) / max(y_max - y_min, 1e-9))).astype(np.intp)
    found = pixels[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
    return PointColours(np.ascontiguousarray(found[:, :3]), found[:, 3] > 0)


def paint_classes(cloud: Cloud, values: Array, classes: list[dict[str, Any]]) -> PointColours:
    """Show each point in its class's colour over the dimmed photos; a class without a colour shows these alone."""
    lut = np.zeros((65536, 3), np.float32)
    drawn = np.zeros(65536, bool)
    for item in classes:
        if item.get("colour"):
            lut[item["value"]] = [int(item["colour"][i : i + 2], 16) for i in (1, 3, 5)]
            drawn[item["value"]] = True
    return PointColours(_over(cloud, lut[values], drawn[values]))


def paint_probability(cloud: Cloud, values: Array, limits: tuple[float, float] | None) -> PointColours:
    """Show probabilities (S,) as a colour scale over the dimmed photos, and these alone where the value is NaN."""
    limits = limits or (0.0, 1.0)
    known = ~np.isnan(values)
    levels = _levels(np.where(known, values, 0), limits)
    return PointColours(_over(cloud, _scale()[levels].astype(np.float32), known), range=limits)


def _over(cloud: Cloud, colours: NDArray[np.float32], drawn: NDArray[np.bool_]) -> NDArray[np.uint8]:
    grey = DIM * (cloud.rgb @ np.array([0.299, 0.587, 0.114], np.float32))[:, None]
    return np.rint(np.where(drawn[:, None], grey + (1 - DIM) * colours, grey)).astype(np.uint8)


def _known(values: Array) -> NDArray[np.bool_] | None:
    """Return which of the values (S,) are not NaN; None where all are."""
    known = ~np.isnan(values)
    return None if known.all() else known


def _percentiles(values: Array) -> tuple[float, float]:
    values = values[~np.isnan(values)]
    if not values.size:
        return 0.0, 0.0
    low, high = np.percentile(values, STRETCH_PERCENT)
    return float(low), float(high)


def _levels(values: Array, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """Scale to 0..255 between the limits; 128 everywhere if these are equal, 0 for NaN."""
    low, high = limits
    if not high > low:
        return np.full(len(values), 128, np.uint8)
    levels = np.clip((values - low) * (255 / (high - low)), 0, 255)
    return np.rint(np.nan_to_num(levels)).astype(np.uint8)


@lru_cache(maxsize=1)
def _scale() -> NDArray[np.uint8]:
    """Return 256 colours of equal perceived steps, (256, 3)."""
    return np.asarray(np.rint(np.asarray(Colormap(COLOUR_MAP).lut(256))[:, :3] * 255), np.uint8)


# ---- drawing ------------------------------------------------------------------------------------------


def draw(cloud: Cloud, points: PointColours, grid: Grid, size: int) -> Picture:
    """Draw the picture, its longer side at most ``size`` pixels.

    ``cube``: the cube's pixels, row 0 at the top, reduced where they are more than ``size``. ``marker``: the
    view from above, x to the right, y up, in cells at least as wide as the points' distance.
    """
    extent: tuple[float, float, float, float] | None = None
    colours = points.colours if points.colours.ndim == 2 else points.colours[:, None]
    if grid == "cube":
        pixels = _on_cube(cloud, colours, points.shown)
    else:
        pixels, extent = _from_above(cloud, colours, points.shown, size)
    image = Image.fromarray(pixels, "LA" if pixels.shape[2] == 2 else "RGBA")
    if max(image.size) > size:
        share = size / max(image.size)
        width, height = (max(1, round(side * share)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.BOX)
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=_COMPRESSION)
    return Picture(out.getvalue(), points.range, extent)


def _on_cube(cloud: Cloud, colours: NDArray[np.uint8], shown: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """Draw in the cube's pixels, (rows, cols, channels + 1), alpha last; a pixel has at most one point."""
    row, col = cloud.hsi_pixel.T.astype(np.intp)
    match cloud.attributes.get("cube_shape"):
        case [int(rows), int(cols), *_]:
            pass
        case _:  # a cloud that another program wrote
            rows, cols = int(row.max()) + 1, int(col.max()) + 1
    pixels = np.zeros((rows, cols, colours.shape[1] + 1), np.uint8)
    pixels[row, col, :-1] = colours
    pixels[row, col, -1] = 255
    if shown is not None:
        pixels[row[~shown], col[~shown]] = 0
    return pixels


def _from_above(
    cloud: Cloud, colours: NDArray[np.uint8], shown: NDArray[np.bool_] | None, size: int
) -> tuple[NDArray[np.uint8], tuple[float, float, float, float]]:
    """Draw the view from above, y up, as means over the topmost points of each cell; and return its outer edges, mm."""
    x_min, y_min, x_max, y_max = extent_mm(cloud)
    # Neighbours in the cloud's order mostly are neighbours in the cube.
    steps = np.linalg.norm(np.diff(cloud.xyz[:, :2], axis=0), axis=1)
    pitch = float(np.median(steps)) if len(steps) else 0.0
    cell_mm = max(_PITCH_CELLS * pitch, max(x_max - x_min, y_max - y_min) / max(size - 1, 1), 1e-3)
    view = top_view(cloud, cell_mm)
    seen = view.top if shown is None else view.top & shown
    cell, cells = view.cell[seen], view.rows * view.cols
    count = np.bincount(cell, minlength=cells)
    channels = colours.shape[1]
    pixels = np.zeros((cells, channels + 1), np.uint8)
    for i in range(channels):
        total = np.bincount(cell, weights=colours[seen, i], minlength=cells)
        pixels[:, i] = np.rint(total / np.maximum(count, 1))
    pixels[:, -1] = np.where(count > 0, 255, 0)
    half = cell_mm / 2
    edges = (x_min - half, y_min - half, x_min + view.cols * cell_mm - half, y_min + view.rows * cell_mm - half)
    return np.ascontiguousarray(pixels.reshape(view.rows, view.cols, -1)[::-1]), edges

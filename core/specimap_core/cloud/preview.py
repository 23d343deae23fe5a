"""A picture of a cloud: the top view, coloured with the first three principal components of its spectra."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.atomic import atomic_path
from specimap_core.cloud import CHUNK_POINTS, Cloud, Flag
from specimap_core.cloud.top_view import TopView, extent_mm, top_view

COLOURS = 3
GRID_MM = 0.1
STRETCH_PERCENT = (2.0, 98.0)
FILL_CELLS = 2.0
"""A cell without points takes the colour of the nearest that has, if that is at most this far."""
MOST_PIXELS_A_SIDE = 4096
_SAMPLED_CHUNKS = 96
_BLOCK = 4096
# Points that lack more of the bands than this have no colour.
_MOST_HOLES = 0.5
_SEED = 0


@dataclass(frozen=True, eq=False)
class Components:
    """Principal components of standardised spectra: ``scores = spectra @ weights + bias``, (n, 3) in 0..1.

    ``weights`` (B, 3), zero for bands left out; ``bias`` (3,). The stretch to 0..1 is in them. ``mean`` (B,) of the
    sample.
    """

    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    mean: NDArray[np.float32]

    def colours(self, spectra: Array) -> NDArray[np.float32]:
        """Spectra (n, B) as colours (n, 3), not yet clipped to 0..1."""
        return np.asarray(spectra.astype(np.float32) @ self.weights + self.bias)


def pca_colours(sample: Array, bad_bands: NDArray[np.bool_] | None = None) -> Components:
    """The components of a sample of spectra (n, B), standardised by band; bad and constant bands left out.

    Each component's 2nd to 98th percentile in the sample maps to 0..1. Its sign, which is arbitrary, is such
    that the largest loading is positive. A component without spread gives 0.5 everywhere.
    """
    bands = sample.shape[1]
    values = sample.astype(np.float32)
    mean, std = values.mean(0), values.std(0)
    used = std > 1e-6 * np.maximum(np.abs(mean), 1e-6)
    if bad_bands is not None and (used & ~bad_bands).any():
        used &= ~bad_bands
    weights, bias = np.zeros((bands, COLOURS), np.float32), np.full(COLOURS, 0.5, np.float32)
    count = min(COLOURS, int(used.sum()))
    if not count:
        return Components(weights, bias, mean)
    standard = (values[:, used] - mean[used]) / std[used]
    loadings = np.linalg.eigh(standard.T @ standard)[1][:, ::-1][:, :count]
    largest = np.abs(loadings).argmax(0)
    loadings = loadings * np.sign(loadings[largest, np.arange(count)])
    low, high = np.percentile(standard @ loadings, STRETCH_PERCENT, axis=0)
    span = high - low
    visible = span > 1e-6
    gain = np.where(visible, 1 / np.where(visible, span, 1), 0)
    weights[used, :count] = loadings / std[used, None] * gain
    bias[:count] = np.where(visible, -low * gain - mean[used] @ weights[used, :count], 0.5)
    return Components(weights, bias, mean)


def sampled_spectra(cloud: Cloud) -> NDArray[np.uint16]:
    """Stored spectra (n, B) of randomly chosen chunks, the same at each call: whole tiles read fast.

    Points that are saturated or lack a value are left out, unless all are so.
    """
    chunks = -(-cloud.n_points // CHUNK_POINTS)
    chosen = np.random.default_rng(_SEED).permutation(chunks)[:_SAMPLED_CHUNKS]
    starts = np.sort(chosen) * CHUNK_POINTS
    parts = [slice(start, start + CHUNK_POINTS) for start in starts.tolist()]
    spectra = np.concatenate([cloud.stored_spectra(part) for part in parts])
    unsound = np.concatenate([cloud.flags[part] for part in parts]) & (Flag.NO_DATA | Flag.SATURATED) > 0
    return spectra if unsound.all() else spectra[~unsound]


def _fill_missing(
    colours: NDArray[np.float32], spectra: NDArray[np.uint16], components: Components, fill_value: int
) -> NDArray[np.bool_]:
    """Give points without a value in some bands the colour of the others; whether each has enough of them."""
    used = (components.weights != 0).any(1)
    holes = (spectra == fill_value) & used
    few = holes.sum(1)
    (some,) = np.nonzero(few)
    if some.size:
        # A band's mean in the sample has no part in any component.
        stored = np.where(holes[some], components.mean, spectra[some])
        colours[some] = components.colours(stored)
    return np.asarray(few <= _MOST_HOLES * max(int(used.sum()), 1))


def preview_grid_mm(cloud: Cloud, grid_mm: float = GRID_MM) -> float:
    """Cell of the preview: ``grid_mm``, or coarser where the picture would exceed 4096 pixels a side."""
    x_min, y_min, x_max, y_max = extent_mm(cloud)
    least = max(x_max - x_min, y_max - y_min) / (MOST_PIXELS_A_SIDE - 1)
    return max(grid_mm, least) if grid_mm > 0 else grid_mm


def write_preview(cloud: Cloud, path: Path, grid_mm: float = GRID_MM) -> None:
    """Write the top view as a PNG with transparency where there is nothing: x to the right, y up.

    A pixel is a cell of ``grid_mm`` (coarser where the picture would exceed 4096 pixels a side), coloured by the
    mean of its topmost points. Raises SettingsError for a grid that is not positive, StorageFullError,
    OutputNotWritableError, CloudDamagedError.
    """
    view = top_view(cloud, preview_grid_mm(cloud, grid_mm))
    components = pca_colours(sampled_spectra(cloud), cloud.bad_bands)
    colours = np.empty((cloud.n_points, COLOURS), np.float32)
    shown = np.ones(cloud.n_points, bool)
    for part, spectra in cloud.iter_chunks(_BLOCK):
        colours[part] = components.colours(spectra)
        if cloud.fill_value is not None:
            shown[part] = _fill_missing(colours[part], spectra, components, cloud.fill_value)
    np.clip(colours, 0, 1, out=colours)
    image = view_picture(view, 255 * colours, shown)
    done, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise RuntimeError("OpenCV could not encode a PNG")
    with atomic_path(path) as aside:
        aside.write_bytes(png.data)


def view_picture(view: TopView, colours: Array, shown: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """RGBA (rows, cols, 4) with y up: mean of the colours (S, 3), 0..255, of each cell's topmost points, small holes
    filled; points that are not ``shown`` (S,) do not count."""
    top = view.top if shown is None else view.top & shown
    cell, size = view.cell[top], view.rows * view.cols
    count = np.bincount(cell, minlength=size)
    image = np.zeros((size, 4), np.uint8)
    for i in range(COLOURS):
        total = np.bincount(cell, weights=colours[top, i], minlength=size)
        image[:, i] = np.rint(total / np.maximum(count, 1))
    image[:, 3] = np.where(count > 0, 255, 0)
    source = nearest_covered((count > 0).reshape(view.rows, view.cols))
    filled = np.where(source[..., None] >= 0, image[source], 0)
    return np.ascontiguousarray(filled[::-1])


def nearest_covered(covered: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The cell (rows, cols), row-major, whose value each cell takes: its own where it is covered, else that of the
    nearest that is, if that is at most :data:`FILL_CELLS` away, else -1."""
    source = np.where(covered, np.arange(covered.size).reshape(covered.shape), -1)
    if covered.all() or not covered.any():
        return source
    empty = (~covered).astype(np.uint8)
    distance, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    cell_of = np.zeros(int(nearest.max()) + 1, np.intp)
    cell_of[nearest[covered]] = source[covered]
    near = (distance > 0) & (distance <= FILL_CELLS)
    source[near] = cell_of[nearest[near]]
    return source

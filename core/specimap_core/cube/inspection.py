"""Inspect a cube for usable values. Cheap: a few sampled rows and the mean image, no second pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cube.model import Cube
from specimap_core.cube.outliers import saturated_share
from specimap_core.cube.pixels import sampled_rows
from specimap_core.errors import CubeContentError
from specimap_core.notices import Notice, Notices

_SAMPLED_ROWS = 24
_SAMPLED_PIXELS = 24 * 512
# Fewer pixels at the largest value than this are glints or dead pixels, no saturation worth a word.
_LEAST_SATURATED_SHARE = 0.001
_LEAST_ZERO_SHARE = 0.002


def inspect(cube: Cube, mean: NDArray[np.float32]) -> Notices:
    """Warnings about a cube's values; ``mean`` (rows, cols) is its mean image.

    Codes: ``single_band``, ``bands_all_zero``, ``pixels_nan``, ``values_nan``, ``pixels_zero``, ``saturated``. Raises
    CubeContentError for a cube without finite values, or whose values are all the same.
    """
    if not np.isfinite(mean).any():
        raise CubeContentError(
            f"{cube.path.name} holds no finite value.", advice="Export the cube again; check its data type."
        )
    sample, columns = _sample(cube)
    finite = sample[np.isfinite(sample)]
    if np.ptp(mean[np.isfinite(mean)]) == 0 and (not finite.size or np.ptp(finite) == 0):
        raise CubeContentError(
            f"All values of {cube.path.name} are the same.",
            advice="Check that the shutter was open and that the right file was given.",
        )
    warnings: list[Notice] = []
    if cube.bands == 1:
        warnings.append(Notice("single_band", "The cube has one band only: it carries no spectra."))
    zero = ~sample.any((0, 1)) & ~cube.bad_bands
    if zero.any():
        listed = ", ".join(str(i) for i in np.flatnonzero(zero)[:8]) + (", ..." if zero.sum() > 8 else "")
        warnings.append(Notice("bands_all_zero", f"{int(zero.sum())} bands hold zeros only: {listed}."))
    lost = int(np.isnan(mean).sum())
    if lost:
        warnings.append(Notice("pixels_nan", f"{lost} of {mean.size} pixels hold no value in any good band."))
    zero_pixels = int((mean == 0).sum())
    if zero_pixels > _LEAST_ZERO_SHARE * mean.size:
        text = f"{zero_pixels} of {mean.size} pixels are zero in all good bands, as where nothing was recorded."
        warnings.append(Notice("pixels_zero", f"{text} Their points are flagged (128)."))
    if sample.dtype.kind == "f":
        missing = np.isnan(sample[..., ~cube.bad_bands])
        partly = missing & ~missing.all(-1, keepdims=True)
        holes = float(partly.mean())
    else:
        holes = 0.0
    if holes:
        text = f"About {holes:.2%} of the values are missing in pixels that have others."
        warnings.append(Notice("values_nan", text))
    share = saturated_share(sample[..., ~cube.bad_bands], _level(cube, columns))
    if share > _LEAST_SATURATED_SHARE:
        warnings.append(Notice("saturated", f"About {share:.1%} of the pixels are saturated in at least one band."))
    return tuple(warnings)


def _sample(cube: Cube) -> tuple[Array, slice]:
    """Pixels of evenly spread rows and columns, (n, k, bands); which columns."""
    rows = sampled_rows(cube.rows, _SAMPLED_ROWS)
    columns = slice(None, None, max(1, len(rows) * cube.cols // _SAMPLED_PIXELS))
    return np.concatenate([cube.read_rows(r, r + 1)[:, columns] for r in rows]), columns


def _level(cube: Cube, columns: slice) -> Array | None:
    """The level of saturation of these columns' good bands, as it broadcasts to (k, good bands)."""
    level = cube.saturation
    if level is None or level.ndim == 0:
        return level
    return level[~cube.bad_bands] if level.ndim == 1 else level[columns][:, ~cube.bad_bands]

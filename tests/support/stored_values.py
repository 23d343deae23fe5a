"""Cubes whose values are known, and what the cloud stores of them, as other programs read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray
import zarr
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import Cube, inspect
from tests.support.cloud_scene import scene
from tests.support.cube_files import Values
from tests.support.value_files import WRITERS

FORMATS = sorted(WRITERS)


def truth(rows: int = 20, cols: int = 24, bands: int = 6) -> Floats:
    """Reflectance in steps of 1e-4, between 0.02 and 0.9."""
    rng = np.random.default_rng(5)
    values = rng.uniform(0.1, 1, (rows, cols, 1)) * rng.uniform(0.3, 0.9, (rows, cols, bands))
    return np.asarray(np.rint(values.clip(0.02, 0.9) * 1e4) / 1e4)


def codes(cube: Cube) -> set[str]:
    return {w.code for w in (*cube.warnings, *inspect(cube, cube.mean_image()))}


def as_image(cube: Cube, folder: Path) -> tuple[Floats, NDArray[np.uint8], Cloud]:
    """The cloud's spectra and flags by pixel, as zarr and xarray read them, which agree with our own reader."""
    write_cloud(folder / "c.zarr", scene(cube.rows, cube.cols, 1.0), cube, {})
    group = zarr.open_group(folder / "c.zarr", mode="r")
    stored, attributes = np.asarray(group["spectra"]), group["spectra"].attrs
    values = stored * float(attributes.get("scale_factor", 1.0)) + float(attributes.get("add_offset", 0.0))  # type: ignore[arg-type]
    values[stored == attributes.get("_FillValue", -1)] = np.nan
    cloud = Cloud.open(folder / "c.zarr")
    np.testing.assert_allclose(cloud.spectra(slice(None)), values, rtol=1e-6, atol=1e-6)
    with xarray.open_zarr(folder / "c.zarr", consolidated=False) as dataset:
        np.testing.assert_allclose(dataset["spectra"].values, values, rtol=1e-6, atol=1e-6)
    at = tuple(cloud.hsi_pixel.astype(int).T)
    image, flags = np.empty((cube.rows, cube.cols, cube.bands)), np.empty((cube.rows, cube.cols), np.uint8)
    image[at], flags[at] = values, np.asarray(group["flags"])
    return image, flags, cloud


def flagged(flags: NDArray[np.uint8], flag: Flag) -> NDArray[np.bool_]:
    return np.asarray((flags & flag) > 0)


def counts(bits: int, dtype: str = "u2") -> tuple[Values, NDArray[np.bool_]]:
    """A scene of a sensor of so many bits, and which pixels it saturates."""
    rng = np.random.default_rng(2)
    values = rng.gamma(2.0, 0.2, (60, 50, 1)) * rng.uniform(0.5, 1.0, (60, 50, 8)) * 2**bits
    stored = np.minimum(values, 2**bits - 1).astype(dtype)
    return stored, np.asarray((stored == 2**bits - 1).any(-1))

"""Kinds of values that people met in their cubes: the small inputs of the test data, against their right values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import inspect, open_cube
from tests.support.cloud_scene import scene


def read(data_dir: Path, folder: Path, name: str) -> tuple[Array, Array, Cloud, set[str]]:
    """Spectra and flags by pixel of the cloud, and the codes of all warnings."""
    cube = open_cube(data_dir / "field" / f"{name}.hdr")
    written = write_cloud(folder / "c.zarr", scene(cube.rows, cube.cols, 1.0), cube, {})
    warnings = (*cube.warnings, *inspect(cube, cube.mean_image()), *written.warnings())
    cloud = Cloud.open(folder / "c.zarr")
    spectra = np.empty((cube.rows, cube.cols, cube.bands), np.float32)
    flags = np.empty((cube.rows, cube.cols), np.uint8)
    at = tuple(cloud.hsi_pixel.astype(int).T)
    spectra[at], flags[at] = cloud.spectra(slice(None)), cloud.flags
    return spectra, flags, cloud, {w.code for w in warnings}


def stored(data_dir: Path, name: str, dtype: str) -> Array:
    """The values of a file, (rows, cols, bands)."""
    return np.fromfile(data_dir / "field" / f"{name}.raw", dtype).reshape(16, 6, 6).transpose(1, 2, 0)


@pytest.mark.parametrize(
    ("name", "dtype", "scale"), [("ignore_in_scene", "<i2", 1e-4), ("ignore_border_float", "<f4", 1.0)]
)
def test_ignore_values(data_dir: Path, tmp_path: Path, name: str, dtype: str, scale: float) -> None:
    raw = stored(data_dir, name, dtype)
    spectra, flags, cloud, codes = read(data_dir, tmp_path, name)
    hole = raw == -9999
    assert 0 < hole.mean() < 0.5
    np.testing.assert_allclose(spectra, np.where(hole, np.nan, raw * scale), rtol=0, atol=0.51e-4)
    assert ((flags & Flag.NO_DATA > 0) == hole.any(-1)).all()
    assert cloud.quantity == "reflectance"
    assert {"pixels_nan", "points_no_data"} <= codes


def test_twelve_bits(data_dir: Path, tmp_path: Path) -> None:
    raw = stored(data_dir, "twelve_bits", "<u2")
    spectra, flags, _, codes = read(data_dir, tmp_path, "twelve_bits")
    np.testing.assert_array_equal(spectra, raw)
    assert ((flags & Flag.SATURATED > 0) == (raw == 4095).any(-1)).all()
    assert flags.any()
    assert "saturated" in codes


def test_gains_and_offsets(data_dir: Path, tmp_path: Path) -> None:
    gains, offsets = np.linspace(5e-5, 1.5e-4, 16), np.linspace(-0.05, 0.05, 16)
    right = stored(data_dir, "gains_offsets", "<u2") * gains + offsets
    truth = stored(data_dir, "says_nm_is_um", "<u2") / 1e4
    spectra, flags, cloud, _ = read(data_dir, tmp_path, "gains_offsets")
    np.testing.assert_allclose(right, truth, rtol=0, atol=0.76e-4)  # the gains' own steps
    np.testing.assert_allclose(spectra, right, rtol=0, atol=0.51e-4)
    assert cloud.quantity == "reflectance"
    assert not flags.any() or (flags & (Flag.NO_DATA | Flag.SATURATED) == 0).all()


def test_a_factor_for_floats(data_dir: Path, tmp_path: Path) -> None:
    spectra, _, cloud, codes = read(data_dir, tmp_path, "factor_for_floats")
    np.testing.assert_allclose(spectra, stored(data_dir, "factor_for_floats", "<f4"), rtol=0, atol=0.51e-4)
    assert cloud.quantity == "reflectance"
    assert "reflectance_factor_unused" in codes


def test_negative_reflectance(data_dir: Path, tmp_path: Path) -> None:
    raw = stored(data_dir, "negative_reflectance", "<i2")
    assert raw.min() < 0
    spectra, _, _, _ = read(data_dir, tmp_path, "negative_reflectance")
    np.testing.assert_allclose(spectra, raw / 1e4, rtol=0, atol=1e-6)

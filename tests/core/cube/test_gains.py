"""Gains, offsets and factors in each format, through to the stored cloud as reflectance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.cloud import Flag
from specimap_core.cube import open_cube
from specimap_core.errors import CubeHeaderError
from tests.support.cube_files import random_values, write_envi
from tests.support.notices import messages
from tests.support.stored_values import FORMATS, as_image, codes, flagged, truth
from tests.support.value_files import WRITERS, listed


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("form", ["one", "each", "gain", "offset"])
def test_gains_and_offsets_give_reflectance_to_the_last_digit(tmp_path: Path, name: str, form: str) -> None:
    right = truth()
    gains: Floats | None = np.linspace(0.5e-4, 1.5e-4, 6) if form == "each" else np.array([0.5e-4])
    offsets = np.linspace(-0.05, 0.05, 6) if form == "each" else np.array([-0.0123])
    if form == "offset" or gains is None:
        gains, stored = None, (right - offsets).astype("f4")
    else:
        stored = np.rint((right - (0 if form == "gain" else offsets)) / gains).astype("i2")
        right = stored * gains + (0 if form == "gain" else offsets)
    cube = open_cube(WRITERS[name](tmp_path, stored, None, gains, None if form == "gain" else offsets))
    assert cube.quantity == "reflectance"
    factor = cube.to_reflectance or 0
    np.testing.assert_allclose(cube.read_rows(0, 20) * factor, right, rtol=0, atol=2e-7)
    np.testing.assert_allclose(cube.band(3) * factor, right[..., 3], rtol=0, atol=2e-7)
    image, flags, cloud = as_image(cube, tmp_path)
    assert cloud.quantity == "reflectance"
    np.testing.assert_allclose(image, right, rtol=0, atol=0.502e-4)
    assert (flags & (Flag.NO_DATA | Flag.SATURATED) == 0).all()


@pytest.mark.parametrize("name", FORMATS)
def test_gains_of_other_quantities_are_applied_too(tmp_path: Path, name: str) -> None:
    stored = random_values("i2", (20, 24, 6)) // 2
    gains, offsets = np.linspace(0.5, 2, 6), np.linspace(-100, 900, 6)
    cube = open_cube(WRITERS[name](tmp_path, stored, None, gains, offsets))
    assert cube.quantity == "counts"
    image, _, cloud = as_image(cube, tmp_path)
    np.testing.assert_allclose(image, stored * gains + offsets, rtol=0, atol=0.51 * cloud.scale_factor)


@pytest.mark.parametrize("name", [n for n in FORMATS if n != "tiff"])  # GDAL's XML has an entry for each band
@pytest.mark.parametrize(
    ("gains", "offsets", "field"),
    [
        (np.ones(5), None, "gain"),
        (None, np.ones(7), "offset"),
        (np.array([0.0]), None, "gain"),
        (np.array([np.nan]), None, "gain"),
        (None, np.array([np.inf]), "offset"),
    ],
)
def test_wrong_gains_are_refused_by_name(
    tmp_path: Path, name: str, gains: Floats | None, offsets: Floats | None, field: str
) -> None:
    path = WRITERS[name](tmp_path, np.rint(truth() * 1e4).astype("i2"), None, gains, offsets)
    with pytest.raises(CubeHeaderError) as caught:
        open_cube(path)
    named = {"gain": ("data gain values", "scale_factor"), "offset": ("data offset values", "add_offset")}[field]
    assert caught.value.details["field"] in named
    assert caught.value.details["field"] in caught.value.message


def test_idle_gains_leave_counts_alone(tmp_path: Path) -> None:
    stored = random_values("u2")
    path = write_envi(
        tmp_path / "x.hdr", stored, data_gain_values=listed(np.ones(11)), data_offset_values=listed(np.zeros(11))
    )
    cube = open_cube(path)
    assert cube.dtype == np.uint16
    assert cube.quantity == "counts"
    np.testing.assert_array_equal(cube.read_rows(0, 7), stored)


@pytest.mark.parametrize(
    ("attributes", "factor", "code"),
    [
        ({"scale_factor": 1e-4}, 1e-4, None),
        ({"Scale_Factor": 10000.0}, 1e-4, None),  # as NEON writes it
        ({"reflectance_scale_factor": 10000}, 1e-4, None),
        ({"scale_factor": 10000.0}, 1e-4, "scale_assumed"),
        ({"Scale_Factor": 10000.0, "Data_Ignore_Value": -9999}, 1e-4, None),
    ],
)
def test_which_way_a_scale_goes(tmp_path: Path, attributes: dict[str, Any], factor: float, code: str | None) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["Reflectance_Data"], f["wavelength"] = np.rint(truth() * 1e4).astype("i2"), np.linspace(400, 900, 6)
        f["Reflectance_Data"].attrs.update(attributes)
    cube = open_cube(tmp_path / "x.h5")
    np.testing.assert_allclose(cube.read_rows(0, 20) * (cube.to_reflectance or 0), truth(), atol=1e-7)
    assert cube.to_reflectance == pytest.approx(factor)
    assert ("scale_assumed" in codes(cube)) == (code is not None)


def test_a_factor_for_values_that_are_reflectance_already(tmp_path: Path) -> None:
    cube = open_cube(write_envi(tmp_path / "x.hdr", truth().astype("f4"), reflectance_scale_factor=10000))
    assert "reflectance_factor_unused" in codes(cube)
    image, _, _ = as_image(cube, tmp_path)
    np.testing.assert_allclose(image, truth(), rtol=0, atol=1e-9)
    scaled = open_cube(write_envi(tmp_path / "y.hdr", (truth() * 1e4).astype("f4"), reflectance_scale_factor=10000))
    assert scaled.to_reflectance == pytest.approx(1e-4)
    assert "reflectance_factor_unused" not in codes(scaled)


@pytest.mark.parametrize("low", [-0.05, -0.3, -0.9])
@pytest.mark.parametrize("dtype", ["i2", "f4"])
def test_negative_reflectance_is_kept(tmp_path: Path, low: float, dtype: str) -> None:
    right = truth()
    right[2:5, 3:6] = low
    stored = np.rint(right * 1e4).astype("i2") if dtype == "i2" else right.astype("f4")
    stored = stored * np.array(1 if dtype == "i2" else 1e4, dtype)
    cube = open_cube(write_envi(tmp_path / "x.hdr", stored, reflectance_scale_factor=10000))
    image, flags, cloud = as_image(cube, tmp_path)
    np.testing.assert_allclose(image, right, rtol=0, atol=1e-6)
    assert cloud.add_offset == low
    assert (flags & (Flag.NO_DATA | Flag.SATURATED) == 0).all()


@pytest.mark.parametrize(
    ("factor", "offset", "said"),
    [
        (1e-2, 0, "more than"),
        (30, 0, "percent"),
        (900, 0, "scale seems wrong"),
        (-1, 0, "negative"),
        (1, -0.7, "below"),
    ],
)
def test_implausible_reflectance_is_said(tmp_path: Path, factor: float, offset: float, said: str) -> None:
    values = ((truth() * factor + offset) * 1e4).astype("f4")
    cube = open_cube(write_envi(tmp_path / "x.hdr", values.astype("i4"), reflectance_scale_factor=10000))
    assert said in messages(cube.warnings)["reflectance_implausible"]


def test_integers_of_reflectance_are_copied_bit_for_bit(tmp_path: Path) -> None:
    stored = np.rint(truth() * 1e4).astype("u2")
    stored[0, 0] = 65535
    cube = open_cube(write_envi(tmp_path / "x.hdr", stored, reflectance_scale_factor=10000))
    assert cube.dtype == np.uint16
    _, flags, cloud = as_image(cube, tmp_path)
    assert (cloud.fill_value, cloud.add_offset) == (None, 0)
    at = tuple(cloud.hsi_pixel.astype(int).T)
    np.testing.assert_array_equal(cloud.stored_spectra(slice(None)), stored[at])
    assert np.argwhere(flagged(flags, Flag.SATURATED)).tolist() == [[0, 0]]

"""Saturated values, dead elements of the detector, and references that have either."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap_core.cloud import Flag
from specimap_core.cube import open_cube
from tests.support.cube_files import write_envi
from tests.support.notices import messages
from tests.support.stored_values import FORMATS, as_image, codes, counts, flagged, truth
from tests.support.value_files import WRITERS, listed


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_what_a_sensor_of_few_bits_saturates_is_flagged(tmp_path: Path, bits: int) -> None:
    stored, right = counts(bits)
    assert 0.002 < right.mean() < 0.2
    cube = open_cube(write_envi(tmp_path / "x.hdr", stored))
    assert "saturated" in codes(cube)
    _, flags, _ = as_image(cube, tmp_path)
    assert (flagged(flags, Flag.SATURATED) == right).all()


def test_saturation_is_that_of_the_raw_counts(tmp_path: Path) -> None:
    stored, right = counts(12)
    white = np.linspace(2500, 3500, 50 * 8).reshape(1, 50, 8).astype("u2")
    dark = np.full((1, 50, 8), 80, "u2")
    cube = open_cube(
        write_envi(tmp_path / "x.hdr", stored),
        white=write_envi(tmp_path / "w.hdr", white),
        dark=write_envi(tmp_path / "d.hdr", dark),
    )
    assert "saturated" in codes(cube)
    image, flags, _ = as_image(cube, tmp_path)
    assert (flagged(flags, Flag.SATURATED) == right).all()
    expected = (stored.astype(float) - dark) / (white.astype(float) - dark)
    np.testing.assert_allclose(image, expected, rtol=0, atol=0.51e-4)


def test_saturation_survives_gains(tmp_path: Path) -> None:
    stored, right = counts(12)
    path = write_envi(
        tmp_path / "x.hdr",
        stored,
        data_gain_values=listed(np.linspace(0.01, 0.03, 8)),
        data_offset_values=listed(np.linspace(-1, 1, 8)),
    )
    _, flags, _ = as_image(open_cube(path), tmp_path)
    assert (flagged(flags, Flag.SATURATED) == right).all()


def test_a_declared_ceiling(tmp_path: Path) -> None:
    stored, _ = counts(12)
    stored = np.minimum(stored, 3000).astype("u2") // 2
    stored[4, 5, 6] = 3500
    path = write_envi(tmp_path / "x.hdr", stored, ceiling=3500)
    _, flags, _ = as_image(open_cube(path), tmp_path)
    assert flagged(flags, Flag.SATURATED)[4, 5]


@pytest.mark.parametrize(
    ("dtype", "value"), [("f4", 1e6), ("f4", 0.0), ("u2", 65535), ("u2", 0), ("u2", 4115), ("u2", 50000)]
)
def test_dead_columns_are_left_out_and_named(tmp_path: Path, dtype: str, value: float) -> None:
    stored, saturated = counts(12, dtype)
    stored = stored + np.array(20, dtype)
    saturated = np.asarray((stored == 4115).any(-1))
    dead = np.zeros(stored.shape, bool)
    dead[:, 7] = dead[:, 30:32] = True
    dead[:, 41, 3] = True
    stored[dead] = value
    cube = open_cube(write_envi(tmp_path / "x.hdr", stored))
    assert codes(cube) & {"detector_dead", "values_absurd"}
    mean = cube.mean_image()
    assert np.isnan(mean[:, [7, 30, 31]]).all()
    assert np.nanmin(mean) > 20
    assert np.nanmax(mean) < 4200
    image, flags, _ = as_image(cube, tmp_path)
    assert (np.isnan(image) == dead).all()
    assert (flagged(flags, Flag.NO_DATA) == dead.any(-1)).all()
    known = ~dead.all(-1)
    assert (flagged(flags, Flag.SATURATED) == saturated)[known].all()


def test_scenes_without_dead_elements_keep_all_values(tmp_path: Path) -> None:
    for bits in (8, 10, 12, 14, 16):
        for dtype in ("u2", "f4", "i4"):
            stored, _ = counts(bits, dtype)
            cube = open_cube(write_envi(tmp_path / "x.hdr", stored))
            assert cube.dtype == stored.dtype
            assert not codes(cube) & {"detector_dead", "values_absurd", "no_data_undeclared"}


# ---- references ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FORMATS)
def test_references_mean_what_they_say(tmp_path: Path, name: str) -> None:
    """Gains and no-data of a white reference; a column without any value makes no reflectance."""
    right = truth()
    white = np.linspace(1000, 3000, 24 * 6).reshape(1, 24, 6).repeat(4, 0)
    raw = (right * white[:1]).astype("f4")
    stored = np.rint(white / 0.25).astype("i2")
    stored[0, :, :] = -9999
    stored[:, 5, 2] = -9999
    reference = WRITERS[name](tmp_path, stored, -9999.0, np.array([0.25]), None)
    cube = open_cube(write_envi(tmp_path / "raw.hdr", raw), white=reference)
    image, flags, _ = as_image(cube, tmp_path)
    right[:, 5, 2] = np.nan
    np.testing.assert_allclose(image, right, rtol=0, atol=2e-4)
    assert (flagged(flags, Flag.NO_DATA) == np.isnan(right).any(-1)).all()
    assert "reference_invalid" in messages(cube.warnings)


def test_a_saturated_white_and_references_of_another_kind_are_said(tmp_path: Path) -> None:
    raw = write_envi(tmp_path / "raw.hdr", counts(12)[0])
    white = write_envi(tmp_path / "w.hdr", np.full((4, 50, 8), 65535, "u2"))
    assert "white_saturated" in codes(open_cube(raw, white=white))
    scaled = write_envi(tmp_path / "s.hdr", np.full((4, 50, 8), 9000, "u2"), reflectance_scale_factor=10000)
    assert "reference_units_differ" in codes(open_cube(raw, white=scaled))
    own = write_envi(tmp_path / "r.hdr", np.full((4, 50, 8), 4500, "i4"), reflectance_scale_factor=5000)
    image = open_cube(own, white=scaled).read_rows(0, 1)
    np.testing.assert_allclose(image, 1.0, rtol=1e-6)

"""Missing values by kind, declared or found, in each format, through to the stored cloud."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from specimap_core.cloud import Flag
from specimap_core.cube import inspect, open_cube
from specimap_core.errors import CubeContentError, CubeFormatError
from specimap_core.screening.cube import judge_cube
from tests.support.cube_files import write_envi
from tests.support.stored_values import FORMATS, as_image, codes, flagged, truth
from tests.support.value_files import WRITERS


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(
    ("dtype", "no_data"),
    [("i2", -9999.0), ("f4", -9999.0), ("f4", 1.0e34), ("f4", -3.4028235e38), ("f4", 0.0), ("i2", 0.0)],
)
def test_no_data_is_missing_flagged_and_counted(tmp_path: Path, name: str, dtype: str, no_data: float) -> None:
    right = truth()
    hole = np.zeros(right.shape, bool)
    hole[:3] = hole[:, -2:] = True
    hole[9, 9, 2] = True
    stored = np.where(hole, no_data, np.rint(right * 1e4) if dtype == "i2" else right).astype(dtype)
    scale = np.array([1e-4]) if dtype == "i2" else None
    cube = open_cube(WRITERS[name](tmp_path, stored, no_data, scale, None))
    assert cube.quantity == "reflectance"
    read = cube.read_rows(0, cube.rows)
    assert (np.isnan(read) == hole).all()
    assert (np.isnan(cube.band(2)) == hole[..., 2]).all()
    expected = np.where(hole, 0, right).sum(-1) / np.where(hole.all(-1), np.nan, (~hole).sum(-1))
    np.testing.assert_allclose(cube.mean_image() * (cube.to_reflectance or 0), expected, rtol=1e-5)
    assert {"pixels_nan", "values_nan"} <= codes(cube)
    image, flags, _ = as_image(cube, tmp_path)
    np.testing.assert_allclose(image, np.where(hole, np.nan, right), rtol=0, atol=1e-9)
    assert (flagged(flags, Flag.NO_DATA) == hole.any(-1)).all()
    assert not flagged(flags, Flag.SATURATED).any()


@pytest.mark.parametrize("name", FORMATS)
def test_nan_needs_no_words(tmp_path: Path, name: str) -> None:
    right = truth()
    right[4:8, 5:9] = np.nan
    right[0, 0, 0] = np.inf
    cube = open_cube(WRITERS[name](tmp_path, right.astype("f4"), None, None, None))
    image, flags, _ = as_image(cube, tmp_path)
    right[0, 0, 0] = np.nan
    np.testing.assert_allclose(image, right, rtol=0, atol=0.51e-4)
    assert (flagged(flags, Flag.NO_DATA) == np.isnan(right).any(-1)).all()


@pytest.mark.parametrize("value", [-9999.0, 1e34, 9.96921e36, -3.4028235e38])
def test_undeclared_no_data_is_found(tmp_path: Path, value: float) -> None:
    right = truth(40, 30)
    hole = np.zeros(right.shape, bool)
    hole[:20] = True
    cube = open_cube(write_envi(tmp_path / "x.hdr", np.where(hole, value, right).astype("f4")))
    assert codes(cube) & {"no_data_undeclared", "values_absurd"}
    assert cube.quantity == "reflectance"
    assert (np.isnan(cube.read_rows(0, 40)) == hole).all()


def test_no_data_that_the_type_cannot_hold_is_said(tmp_path: Path) -> None:
    stored = np.rint(truth() * 1e4).astype("u2")
    for value in ("-9999", "1e6", "0.5"):
        path = write_envi(tmp_path / "x.hdr", stored, data_ignore_value=value, reflectance_scale_factor=10000)
        cube = open_cube(path)
        assert "no_data_impossible" in codes(cube)
        assert cube.dtype == np.uint16
        np.testing.assert_array_equal(cube.read_rows(0, 20), stored)


@pytest.mark.parametrize("word", ["", "none", "{}", "nan", "NaN"])
def test_words_for_no_no_data_value(tmp_path: Path, word: str) -> None:
    path = write_envi(tmp_path / "x.hdr", truth().astype("f4"), data_ignore_value=word)
    assert not np.isnan(open_cube(path).read_rows(0, 20)).any()


@pytest.mark.parametrize("dtype", [">i2", ">f4", "f2", "f8", "i4"])
@pytest.mark.parametrize("shape", [(20, 24, 6), (1, 24, 6), (20, 1, 6), (20, 24, 1)])
def test_no_data_in_other_types_and_shapes(tmp_path: Path, dtype: str, shape: tuple[int, int, int]) -> None:
    right = np.rint(truth(*shape) * 1000)
    hole = np.random.default_rng(3).random(shape) < 0.3
    np.savez(tmp_path / "x.npz", cube=np.where(hole, -9999, right).astype(dtype), nodata=-9999)
    cube = open_cube(tmp_path / "x.npz")
    assert (np.isnan(cube.read_rows(0, cube.rows)) == hole).all()
    np.testing.assert_allclose(cube.read_rows(0, cube.rows)[~hole], right[~hole], rtol=1e-3)
    assert (np.isnan(cube.band(0)) == hole[..., 0]).all()


def test_attributes_of_cf_for_sign_and_range(tmp_path: Path) -> None:
    stored = np.array([0, 1000, 40000, 65000] * 30, "u2").reshape(4, 5, 6)
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"], f["wavelength"] = stored.view("i2"), np.linspace(400, 900, 6)
        f["cube"].attrs.update({"_Unsigned": "true", "valid_range": np.array([1, 60000])})
    read = open_cube(tmp_path / "x.h5").read_rows(0, 4)
    np.testing.assert_array_equal(read, np.where((stored < 1) | (stored > 60000), np.nan, stored))


def test_words_about_values_do_not_lead_out_of_the_file(tmp_path: Path) -> None:
    stored = np.rint(truth() * 1e4).astype("u2")
    (tmp_path / "secret").write_bytes(np.full(6, 2.0).tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as f:
        f["scale_factor"] = np.full(6, 3.0)
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"], f["wavelength"] = stored, np.linspace(400, 900, 6)
        f.create_dataset("add_offset", (6,), "f8", external=[(str(tmp_path / "secret"), 0, 48)])
        f["scale_factor"] = h5py.ExternalLink("other.h5", "/scale_factor")
        f["no_data"] = h5py.SoftLink("/scale_factor")
    with pytest.raises(CubeFormatError, match="in other files"):
        open_cube(tmp_path / "x.h5")


def test_a_cube_of_no_data_alone_is_refused(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", np.full((20, 24, 6), -9999, "i2"), data_ignore_value=-9999)
    cube = open_cube(path)
    with pytest.raises(CubeContentError):
        inspect(cube, cube.mean_image())
    assert judge_cube(path).verdict == "refused"


def test_the_judgement_of_a_cube_lists_what_was_found(tmp_path: Path) -> None:
    stored = truth(40, 30).astype("f4")
    stored[:9] = -9999
    path = write_envi(tmp_path / "x.hdr", stored, data_ignore_value=-9999, reflectance_scale_factor=10000)
    verdict = judge_cube(path)
    output = {warning["code"] for warning in verdict.facts["warnings"]}
    assert {"pixels_nan", "reflectance_factor_unused"} <= output
    assert verdict.facts["quantity"] == "reflectance"

"""What values mean, by kind of oddity and format, through to the stored cloud as other programs read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
import zarr
from numpy.typing import NDArray

from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import Cube, inspect, open_cube
from specimap_core.errors import CubeContentError, CubeFormatError, CubeHeaderError
from specimap_core.geometry.cameras import Floats
from specimap_core.screening.cube import judge_cube
from tests.support.cloud_scene import scene
from tests.support.cube_files import Values, random_values, write_envi
from tests.support.notices import messages
from tests.support.value_files import WRITERS, listed

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


# ---- no-data ------------------------------------------------------------------------------------------


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
    said = {warning["code"] for warning in verdict.facts["warnings"]}
    assert {"pixels_nan", "reflectance_factor_unused"} <= said
    assert verdict.facts["quantity"] == "reflectance"


# ---- gains, offsets, factors --------------------------------------------------------------------------


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


# ---- saturation and dead elements ---------------------------------------------------------------------


def counts(bits: int, dtype: str = "u2") -> tuple[Values, NDArray[np.bool_]]:
    """A scene of a sensor of so many bits, and which pixels it saturates."""
    rng = np.random.default_rng(2)
    values = rng.gamma(2.0, 0.2, (60, 50, 1)) * rng.uniform(0.5, 1.0, (60, 50, 8)) * 2**bits
    stored = np.minimum(values, 2**bits - 1).astype(dtype)
    return stored, np.asarray((stored == 2**bits - 1).any(-1))


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

"""What a cube's values are: reflectance only where the file does not call them something else."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import xarray

from specimap_core.cube import Cube, inspect, open_cube
from specimap_core.errors import CubeHeaderError
from tests.support.cube_files import Values, write_envi
from tests.support.value_files import NM, listed

SHAPE = (24, 20, 6)


def scene() -> Values:
    rng = np.random.default_rng(8)
    return rng.uniform(0.02, 0.9, SHAPE).astype("f4")


def codes(cube: Cube) -> set[str]:
    return {w.code for w in (*cube.warnings, *inspect(cube, cube.mean_image()))}


def envi(path: Path, **said: Any) -> Path:
    return write_envi(path, scene() / 5, "bil", wavelength=listed(NM), wavelength_units="nm", **said)


def hdf5(path: Path, name: str, **said: str) -> Path:
    with h5py.File(path, "w") as file:
        file[name], file["wavelength"] = scene() / 5, NM
        file["wavelength"].attrs["units"] = "nm"
        file[name].attrs.update(said)
    return path


def netcdf3(path: Path, name: str, **said: str) -> Path:
    dataset = xarray.Dataset({name: (("y", "x", "wavelength"), scene() / 5, said)}, {"wavelength": NM})
    dataset.to_netcdf(path, engine="scipy")
    return path


OTHERS: dict[str, Callable[[Path], Path]] = {
    "ENVI, title of the values": lambda f: envi(f / "x.hdr", z_plot_titles="{Wavelength (nm), Radiance}"),
    "ENVI, description": lambda f: envi(f / "x.hdr", description="{\n  Absorbance, log(1/R)}"),
    "ENVI, gains": lambda f: envi(f / "x.hdr", description="{Radiance}", data_gain_values="{0.01}"),
    "HDF5, name": lambda f: hdf5(f / "x.h5", "L1/radiance"),
    "HDF5, units": lambda f: hdf5(f / "x.h5", "cube", units="uW/cm^2/SR/nm"),
    "HDF5, units in powers": lambda f: hdf5(f / "x.h5", "cube", units="W m-2 sr-1 um-1"),
    "NetCDF3": lambda f: netcdf3(f / "x.nc", "data", standard_name="toa_outgoing_radiance_per_unit_wavelength"),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_what_a_file_calls_otherwise_is_no_reflectance(tmp_path: Path, kind: str) -> None:
    cube = open_cube(OTHERS[kind](tmp_path))
    assert (cube.quantity, cube.to_reflectance) == ("counts", None)
    assert "quantity_not_reflectance" in codes(cube)


REFLECTANCE: dict[str, Callable[[Path], Path]] = {
    "ENVI, nothing said": lambda f: envi(f / "x.hdr"),
    "ENVI, description of both": lambda f: envi(f / "x.hdr", description="{Radiance to reflectance, empirical line}"),
    "ENVI, radiometric": lambda f: envi(f / "x.hdr", description="{Radiometrically corrected}"),
    "ENVI, units in free text": lambda f: envi(f / "x.hdr", description="{lamp 3 mW/cm2, map in w/ m2}"),
    "ENVI, factor": lambda f: envi(f / "x.hdr", description="{Radiance}", reflectance_scale_factor=1),
    "HDF5": lambda f: hdf5(f / "x.h5", "surface_reflectance", units="1"),
    "HDF5, under radiance": lambda f: hdf5(f / "x.h5", "from_radiance/reflectance"),
    "NetCDF3": lambda f: netcdf3(f / "x.nc", "data", units="unitless", long_name="scan of a tray, srgb preview"),
}


@pytest.mark.parametrize("kind", REFLECTANCE)
def test_reflectance_stays_so(tmp_path: Path, kind: str) -> None:
    cube = open_cube(REFLECTANCE[kind](tmp_path))
    assert (cube.quantity, cube.to_reflectance) == ("reflectance", 1.0)
    assert codes(cube) == set()


def test_radiance_with_a_white_of_radiance_is_reflectance(tmp_path: Path) -> None:
    white = write_envi(tmp_path / "w.hdr", np.full((1, 20, 6), 0.2, "f4"), description="{Radiance}")
    cube = open_cube(envi(tmp_path / "x.hdr", description="{Radiance}"), white=white)
    assert cube.quantity == "reflectance"
    np.testing.assert_allclose(cube.read_rows(0, 24), scene(), rtol=1e-5)
    # An ideal white, the same everywhere, is no clipped one.
    assert codes(cube) == {"dark_missing"}


def test_percent_that_is_called_reflectance_is_said_in_envi(tmp_path: Path) -> None:
    output: dict[str, Any] = {"z_plot_titles": "{Wavelength, Reflectance (%)}"}
    cube = open_cube(write_envi(tmp_path / "x.hdr", scene() * 100, **output))
    assert cube.quantity == "counts"
    assert "reflectance_implausible" in codes(cube)


def test_reflectance_gains_come_before_those_of_radiance(tmp_path: Path) -> None:
    stored = np.rint(scene() * 1e4).astype("u2")
    gains, offsets = np.linspace(0.5e-4, 2e-4, 6), np.linspace(-0.05, 0.05, 6)
    path = write_envi(
        tmp_path / "x.hdr",
        stored,
        description="{Radiance}",
        data_gain_values=listed(gains * 300),
        data_reflectance_gain_values=listed(gains),
        data_reflectance_offset_values=listed(offsets),
    )
    cube = open_cube(path)
    assert (cube.quantity, cube.to_reflectance) == ("reflectance", 1.0)
    np.testing.assert_allclose(cube.read_rows(0, 24), stored * gains + offsets, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("field", ["major frame offsets", "minor frame offsets"])
def test_bytes_between_lines_are_refused(tmp_path: Path, field: str) -> None:
    key = field.replace(" ", "_")
    offset: dict[str, Any] = {key: "{0, 16}"}
    none: dict[str, Any] = {key: "{0, 0}"}
    with pytest.raises(CubeHeaderError) as caught:
        open_cube(write_envi(tmp_path / "x.hdr", scene(), **offset))
    assert caught.value.details["field"] == field
    assert open_cube(write_envi(tmp_path / "y.hdr", scene(), **none)).pixels.shape == SHAPE


@pytest.mark.parametrize("fill", [1e-6, 1e-4])
def test_a_masked_background_does_not_make_the_scene_absurd(tmp_path: Path, fill: float) -> None:
    values = scene()
    values[:, 3:] = fill
    cube = open_cube(write_envi(tmp_path / "x.hdr", values))
    assert codes(cube) == {"wavelengths_missing"}
    np.testing.assert_array_equal(cube.read_rows(0, 24), values)


def test_a_no_data_value_of_gdal_prints_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    values = scene().transpose(2, 0, 1).copy()
    values[:, :5] = np.finfo("f4").min
    tag = (42113, "s", 0, "-3.4028234663852886e+38", True)
    tifffile.imwrite(tmp_path / "x.tif", values, planarconfig="separate", photometric="minisblack", extratags=[tag])
    with caplog.at_level(logging.WARNING):
        read = open_cube(tmp_path / "x.tif").read_rows(0, 24)
    assert np.isnan(read[:5]).all()
    np.testing.assert_array_equal(read[5:], scene()[5:])
    assert not caplog.records
    assert "".join(capfd.readouterr()) == ""

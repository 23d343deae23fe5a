"""Wavelengths in every container and by every name, and headers that give them twice."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from scipy import io as scipy_io

from specimap_core.cube import Cube, open_cube
from specimap_core.errors import CubeHeaderError
from tests.support.cube_files import random_values, write_envi
from tests.support.notices import messages

NM = np.linspace(461.905, 1700, 16)
BANDS = np.arange(1.0, 17)


# ---- every container ------------------------------------------------------------------------------------

Writer = Callable[[Path, Any, Any, str], Path]
VALUES = random_values("u2", (7, 5, 16))


def _envi(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    words = "{" + ", ".join(map(repr, map(float, wavelengths))) + "}"
    return write_envi(folder / "x.hdr", values, wavelength=words, wavelength_units=unit)


def _hdf5(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        f["cube"] = values
        f["wavelength"] = wavelengths
        f["wavelength"].attrs["units"] = unit
    return folder / "x.h5"


def _hdf5_attribute(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        f["scan/cube"] = values
        f["scan"].attrs["wavelengths"] = wavelengths
        f["scan"].attrs["wavelength_units"] = unit
    return folder / "x.h5"


def _hdf5_text(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        f["cube"] = values
        f["meta/wavelengths"] = wavelengths
        f["meta/wavelength_units"] = unit
    return folder / "x.h5"


def _matlab73(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    with h5py.File(folder / "x.mat", "w", userblock_size=512) as f:
        f.create_dataset("cube", data=values.T).attrs["MATLAB_class"] = np.bytes_("uint16")
        f.create_dataset("wavelengths", data=wavelengths[None]).attrs["MATLAB_class"] = np.bytes_("double")
        codes = np.array([[ord(c)] for c in unit], "u2")
        f.create_dataset("wavelength_units", data=codes).attrs["MATLAB_class"] = np.bytes_("char")
    return folder / "x.mat"


def _matlab5(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    scipy_io.savemat(folder / "x.mat", {"cube": values, "wavelengths": wavelengths, "wavelength_units": unit})
    return folder / "x.mat"


def _npz(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    np.savez(folder / "x.npz", cube=values, wavelengths=wavelengths, wavelength_units=unit)
    return folder / "x.npz"


def _netcdf3(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    with scipy_io.netcdf_file(folder / "x.nc", "w") as f:
        for name, size in zip(("y", "x", "band"), values.shape, strict=True):
            f.createDimension(name, size)
        f.createVariable("data", "i2", ("y", "x", "band"))[:] = values
        vector = f.createVariable("wavelength", "f8", ("band",))
        vector[:] = wavelengths
        vector.units = unit
    return folder / "x.nc"


def _tiff(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    described = {"wavelengths": list(map(float, wavelengths)), "wavelength_units": unit}
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(folder / "x.tif", pages, photometric="minisblack", metadata=described)
    return folder / "x.tif"


def _gdal_tiff(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    items = [f'<Item name="wavelength" sample="{i}">{float(w)!r}</Item>' for i, w in enumerate(wavelengths)]
    items += [f'<Item name="wavelength_units" sample="{i}">{unit}</Item>' for i in range(len(wavelengths))]
    xml = f"<GDALMetadata>{''.join(items)}</GDALMetadata>"
    tifffile.imwrite(
        folder / "x.tif",
        np.ascontiguousarray(values.transpose(2, 0, 1)),
        photometric="minisblack",
        planarconfig="separate",
        metadata=None,
        extratags=[(42112, "s", 0, xml, True)],
    )
    return folder / "x.tif"


def _described_tiff(folder: Path, values: Any, wavelengths: Any, unit: str) -> Path:
    words = json.dumps({"note": "x", "Wavelength": list(map(float, wavelengths)), "Wavelength Units": unit})
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(folder / "x.tif", pages, photometric="minisblack", description=words, metadata=None)
    return folder / "x.tif"


CONTAINERS = [
    _envi,
    _hdf5,
    _hdf5_attribute,
    _hdf5_text,
    _matlab73,
    _matlab5,
    _npz,
    _netcdf3,
    _tiff,
    _gdal_tiff,
    _described_tiff,
]


@pytest.mark.parametrize("write", CONTAINERS)
@pytest.mark.parametrize(
    ("wavelengths", "unit", "right", "code"),
    [
        (NM, "Nanometers", NM, None),
        (NM / 1e3, "Micrometers", NM, None),
        (299792.458 / NM, "THz", NM, None),
        (1e7 / NM, "cm-1", NM, None),
        (1239.841984 / NM, "eV", NM, None),
        (NM / 1e3, "nm", NM, "wavelength_units_contradict"),
        (NM, "um", NM, "wavelength_units_contradict"),
        (BANDS, "Index", None, "wavelengths_band_numbers"),
        (BANDS, "Unknown", None, "wavelengths_band_numbers"),
        (NM * 1e5, "nm", None, "wavelengths_implausible"),
    ],
)
def test_units_in_every_container(
    tmp_path: Path, write: Writer, wavelengths: Any, unit: str, right: Any, code: str | None
) -> None:
    values = VALUES.astype("i2") if write is _netcdf3 else VALUES
    cube = open_cube(write(tmp_path, values, wavelengths, unit))
    np.testing.assert_array_equal(cube.read_rows(0, 7), values)
    expected = np.full(16, np.nan) if right is None else right
    np.testing.assert_allclose(cube.wavelengths_nm, expected, rtol=1e-12)
    assert [w.code for w in cube.warnings if w.code.startswith("wavelength")] == ([code] if code else [])


@pytest.mark.parametrize(
    ("name", "factor"),
    [("wavelength_nm", 1), ("wavelengths_um", 1e-3), ("lambda (um)", 1e-3), ("wl_angstrom", 10), ("Wavelength[nm]", 1)],
)
def test_units_in_names(tmp_path: Path, name: str, factor: float) -> None:
    np.savez(tmp_path / "x.npz", allow_pickle=False, **{"cube": VALUES, name: NM * factor})
    np.testing.assert_allclose(open_cube(tmp_path / "x.npz").wavelengths_nm, NM)
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"] = VALUES
        f[name] = NM * factor
        f["wavelength_fwhm"] = np.full(16, 5.0)
        f["wavelength_std"] = np.full(16, 0.1)
    np.testing.assert_allclose(open_cube(tmp_path / "x.h5").wavelengths_nm, NM)


@pytest.mark.parametrize(
    ("name", "unit", "values"),
    [("bands", "nm", NM), ("photon_energy_eV", None, 1239.841984 / NM), ("spectral_axis", "THz", 299792.458 / NM)],
)
def test_vectors_whose_unit_makes_them_wavelengths(tmp_path: Path, name: str, unit: str | None, values: Any) -> None:
    for units, right in ((unit, NM), ("1", np.full(16, np.nan))):
        with h5py.File(tmp_path / "x.h5", "w") as f:
            f["cube"] = VALUES
            f[name] = values
            if units:
                f[name].attrs["units"] = units
        np.testing.assert_allclose(open_cube(tmp_path / "x.h5").wavelengths_nm, right)


def test_ome_channels_name_wavelengths(tmp_path: Path) -> None:
    pages = np.ascontiguousarray(VALUES.transpose(2, 0, 1))
    channel = {"EmissionWavelength": list(map(float, NM)), "EmissionWavelengthUnit": ["nm"] * 16}
    tifffile.imwrite(
        tmp_path / "x.ome.tif", pages, photometric="minisblack", metadata={"axes": "CYX", "Channel": channel}
    )
    cube = open_cube(tmp_path / "x.ome.tif")
    np.testing.assert_array_equal(cube.read_rows(0, 7), VALUES)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)


# ---- ENVI -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("one", "other", "field"),
    [
        ("wavelength = {400, 500, 600}", "wavelength = {1, 2, 3}", "wavelength"),
        ("wavelength units = nm", "Wavelength Units = Micrometers", "wavelength units"),
        ("bbl = {1, 1, 0}", "bbl = {1, 0, 1}", "bbl"),
    ],
)
def test_a_header_that_says_it_twice(tmp_path: Path, one: str, other: str, field: str) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2", (2, 2, 3)))
    text = path.read_text()
    for lines in ((one, other), (other, one)):
        path.write_text(text + "\n".join(lines) + "\n")
        with pytest.raises(CubeHeaderError, match="twice") as caught:
            open_cube(path)
        assert caught.value.details["field"] == field


def test_a_header_that_says_the_same_twice(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2", (2, 2, 3)), wavelength="{400, 500,600.0}")
    path.write_text(
        path.read_text() + "Wavelength = {\n400.0,\n500 , 600}\nwavelength units = nm\nwavelength units = NM\n"
    )
    assert open_cube(path).wavelengths_nm.tolist() == [400, 500, 600]


def field(data_dir: Path, name: str) -> Cube:
    return open_cube(data_dir / "field" / f"{name}.hdr")


def test_inputs_from_the_field(data_dir: Path) -> None:
    for name in ("says_nm_is_um", "says_um_is_nm"):
        cube = field(data_dir, name)
        np.testing.assert_allclose(cube.wavelengths_nm[[0, -1]], [461.905, 1700])
        assert "wavelength_units_contradict" in messages(cube.warnings)
    for name in ("units_index", "units_unknown_index"):
        cube = field(data_dir, name)
        assert np.isnan(cube.wavelengths_nm).all()
        assert "band numbers" in messages(cube.warnings)["wavelengths_band_numbers"]
    with pytest.raises(CubeHeaderError) as caught:
        field(data_dir, "wavelength_twice")
    assert caught.value.details["field"] == "wavelength"
    np.testing.assert_allclose(field(data_dir, "data_hyspex").wavelengths_nm[[0, -1]], [461.905, 1700])

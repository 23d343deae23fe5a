"""Wavelengths in every unit, container and disorder: nanometres, or unknown with a warning."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import io as scipy_io

from specimap_core.cube import Cube, open_cube
from specimap_core.cube.spectral_units import read_unit
from specimap_core.cube.wavelengths import nanometres
from specimap_core.errors import CubeHeaderError
from tests.support.cube_files import random_values, write_envi
from tests.support.notices import messages

NM = np.linspace(461.905, 1700, 16)
BANDS = np.arange(1.0, 17)


@pytest.mark.parametrize(
    ("words", "in_unit"),
    [
        ("nm|Nanometers|NANOMETRES|nano-meter|nano meters|Wavelength (nm)|Wavelength [nm]|wavelength in nm|nm.", NM),
        ("um|µm|μm|Micrometers|micrometre|Microns|micro-meters|Wavelength (um)", NM / 1e3),
        ("mm|Millimeters", NM / 1e6),
        ("cm|Centimeters|centimetre", NM / 1e7),
        ("m|Meters|metre", NM / 1e9),
        ("pm|picometers", NM * 1e3),
        ("Angstroms|Å|Ångström|A|angstrom", NM * 10),
        ("inch|Inches", NM / 25.4e6),
        ("cm-1|cm^-1|1/cm|cm⁻¹|cm**-1|Wavenumber|Wavenumbers (cm-1)|per cm|inverse centimeters|kayser", 1e7 / NM),
        ("m-1|1/m|m^-1", 1e9 / NM),
        ("Hz|hertz", 299792458e9 / NM),
        ("kHz", 299792458e6 / NM),
        ("MHz|mhz|Megahertz", 299792458e3 / NM),
        ("GHz|gigahertz|Frequency (GHz)", 299792458 / NM),
        ("THz|terahertz", 299792.458 / NM),
        ("eV|electron volts|Energy (eV)", 1239.841984 / NM),
        ("meV", 1239841.984 / NM),
        ("keV", 1.239841984 / NM),
    ],
)
def test_units(words: str, in_unit: np.typing.NDArray[np.float64]) -> None:
    for word in words.split("|"):
        nm, warnings = nanometres(in_unit, word, 16)
        np.testing.assert_allclose(nm, NM, rtol=1e-12, err_msg=word)
        assert warnings == (), word


@pytest.mark.parametrize(
    ("values", "unit", "right", "code"),
    [
        (NM / 1e3, "Nanometers", NM, "wavelength_units_contradict"),
        (NM, "Micrometers", NM, "wavelength_units_contradict"),
        (NM, "Meters", NM, "wavelength_units_contradict"),
        (NM / 1e3, "Angstroms", NM, "wavelength_units_contradict"),
        (NM, "bogomips", NM, "wavelength_units_unknown"),
        (NM, "GHz", None, "wavelengths_implausible"),
        (NM * 1e6, "eV", None, "wavelengths_implausible"),
        (NM * 1e6, None, None, "wavelengths_implausible"),
        (np.linspace(5, 300, 16), "nm", None, "wavelengths_implausible"),
        (BANDS, None, None, "wavelengths_band_numbers"),
        (BANDS, "Unknown", None, "wavelengths_band_numbers"),
        (BANDS, "Index", None, "wavelengths_band_numbers"),
        (BANDS, "Band number", None, "wavelengths_band_numbers"),
        (BANDS, "Nanometers", None, "wavelengths_band_numbers"),
        (BANDS, "Micrometers", None, "wavelengths_band_numbers"),
        (BANDS - 1, "", None, "wavelengths_band_numbers"),
        (BANDS[::-1], "", None, "wavelengths_band_numbers"),
        (BANDS + 30, "nm", None, "wavelengths_band_numbers"),
        (BANDS + 30, None, None, "wavelengths_band_numbers"),
        (BANDS + 120, None, None, "wavelengths_band_numbers"),
        (BANDS * 3, "none", None, "wavelengths_band_numbers"),
        (NM, "Index", None, "wavelengths_band_numbers"),
        (NM - 500, "nm", None, "wavelengths_invalid"),
        (np.where(BANDS == 3, np.nan, NM), "nm", None, "wavelengths_invalid"),
        (np.where(BANDS == 3, NM[0], NM), "nm", np.where(BANDS == 3, NM[0], NM), "wavelengths_repeated"),
        (NM[[0, 1, 2, 4, 3, *range(5, 16)]], "nm", NM[[0, 1, 2, 4, 3, *range(5, 16)]], "wavelengths_unordered"),
        (NM[:9], "nm", None, "wavelengths_count_mismatch"),
    ],
)
def test_what_the_numbers_contradict(values: Any, unit: str | None, right: Any, code: str) -> None:
    nm, warnings = nanometres(np.asarray(values, np.float64), unit, 16)
    assert [w.code for w in warnings] == [code]
    np.testing.assert_allclose(nm, np.full(16, np.nan) if right is None else right, rtol=1e-12)


def test_what_is_no_contradiction() -> None:
    for values, unit in (
        (np.arange(400.0, 416), None),
        (np.arange(400.0, 416), "nm"),
        (np.arange(8.0, 15), "um"),
        (NM[::-1], "nm"),
        (np.array([1.0, 2.0]), "um"),
    ):
        nm, warnings = nanometres(values, unit, values.size)
        np.testing.assert_allclose(nm, values * (1e3 if unit == "um" else 1))
        assert warnings == ()


@settings(max_examples=400, deadline=None)
@given(
    values=st.lists(st.floats(1e-20, 1e20), min_size=1, max_size=6),
    unit=st.one_of(
        st.none(), st.text(max_size=12), st.sampled_from(["nm", "um", "mm", "GHz", "THz", "eV", "cm-1", "Index", "A"])
    ),
)
def test_no_number_outside_what_light_has(values: list[float], unit: str | None) -> None:
    nm, warnings = nanometres(np.array(values), unit, len(values))
    if np.isnan(nm).any():
        assert warnings
        assert np.isnan(nm).all()
    else:
        assert nm.min() > 99.999
        assert nm.max() < 100_000.001


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=40))
def test_any_text_is_some_unit(text: str) -> None:
    assert read_unit(text).kind


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
    told = {"wavelengths": list(map(float, wavelengths)), "wavelength_units": unit}
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(folder / "x.tif", pages, photometric="minisblack", metadata=told)
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

"""Units of wavelengths by their words, and numbers that contradict them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specimap_core.cube.spectral_units import read_unit
from specimap_core.cube.wavelengths import nanometres

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

"""The unit of a spectral axis, however it is written: lengths, wavenumbers, frequencies, energies, band numbers."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from typing import Literal

from specimap_core.arrays import Floats
from specimap_core.cube.printable import printable

Kind = Literal["length", "wavenumber", "frequency", "energy", "index", "none", "unrecognised"]

_LONGEST = 1000
_LIGHT_NM_PER_S = 299_792_458e9
_NM_EV = 1_239.841_984  # Planck's constant times the speed of light

_PREFIXES = {
    "": 1.0,
    "p": 1e-12,
    "n": 1e-9,
    "u": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "d": 1e-1,
    "k": 1e3,
    "g": 1e9,
    "t": 1e12,
    "pico": 1e-12,
    "nano": 1e-9,
    "micro": 1e-6,
    "milli": 1e-3,
    "centi": 1e-2,
    "deci": 1e-1,
    "kilo": 1e3,
    "mega": 1e6,
    "giga": 1e9,
    "tera": 1e12,
    "peta": 1e15,
}
_LENGTH = re.compile(r"(p|n|u|m|c|d|k|pico|nano|micro|milli|centi|deci|kilo|)(?:m|met(?:er|re)s?)")
_OTHER_LENGTHS = {
    "micron": 1e3,
    "mu": 1e3,
    "mic": 1e3,
    "a": 0.1,
    "ang": 0.1,
    "angstrom": 0.1,
    "angstroem": 0.1,
    "aa": 0.1,
    "inch": 25.4e6,
    "inche": 25.4e6,
    "in": 25.4e6,
    "mil": 25.4e3,
    "foot": 304.8e6,
    "feet": 304.8e6,
    "ft": 304.8e6,
}
_WAVENUMBER = re.compile(
    r"(?:1/|per|inverse|reciprocal)(?P<inverse>.+)|(?P<power>.+?)(?:\^|\*\*)?[{(]?-1[)}]?|"
    r"(?P<plain>wavenumbers?|kaysers?)"
)
# A lower-case m before Hz is mega in optics: no spectrometer measures thousandths of a hertz.
_FREQUENCY = re.compile(r"(k|m|g|t|p|kilo|mega|giga|tera|peta|)(?:hz|hertz)")
_ENERGY = re.compile(r"(m|k|milli|kilo|)(?:ev|electron-?volts?)")
_INDEX = re.compile(r"(?:band|channel|layer|slice)?(?:index|indices|indexes|numbers?|nr|no|id)|bands?|channels?")
_NONE = {
    "",
    "unknown",
    "none",
    "n/a",
    "na",
    "null",
    "nil",
    "unitless",
    "dimensionless",
    "undefined",
    "unspecified",
    "1",
    "-",
    "--",
    "?",
    "arbitrary",
    "nan",
    "wavelength",
    "wavelengths",
    "lambda",
}


@dataclass(frozen=True)
class Unit:
    """``factor``: nm in one of a length's units, 1/m in a wavenumber's, Hz in a frequency's, eV in an energy's."""

    kind: Kind
    word: str
    factor: float = 1.0

    def to_nm(self, values: Floats) -> Floats:
        """Positive numbers of this unit as wavelengths, nm. Raises ValueError for what is no physical unit."""
        if self.kind == "length":
            return values * self.factor
        if self.kind == "wavenumber":
            return 1e9 / self.factor / values
        if self.kind == "frequency":
            return _LIGHT_NM_PER_S / self.factor / values
        if self.kind == "energy":
            return _NM_EV / self.factor / values
        raise ValueError(f"'{self.word}' is no unit of the spectrum")


def read_unit(text: str | None) -> Unit:
    """The unit that a file's own words mean: ``Nanometers``, ``um``, ``Wavenumbers (cm-1)``, ``GHz``, ``Index``."""
    word = printable(" ".join((text or "")[:_LONGEST].replace("\0", " ").split()))
    plain = unicodedata.normalize("NFKC", word).replace("\N{MINUS SIGN}", "-").replace("\N{GREEK SMALL LETTER MU}", "u")
    plain = plain.replace("\N{LATIN CAPITAL LETTER A WITH RING ABOVE}", "A").lower()
    plain = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
    tokens = [plain]
    # "Wavelength (nm)", "Wavelength [um]", "Wavelength, nm", "wavelength in nm": what stands last is the unit.
    bracketed = re.search(r"[(\[{]([^()\[\]{}]+)[)\]}]\s*$", plain)
    if bracketed and not re.fullmatch(r"\^?-1", bracketed[1].strip()):
        tokens.append(bracketed[1])
    tokens += [re.split(r"[,:;]", plain)[-1], re.sub(r"^.*\b(?:wavelengths?|energy|frequency)\b(?:\s+in)?", "", plain)]
    for token in tokens:
        found = _known(re.sub(r"[\s_.'\"]+", "", token), word)
        if found is not None:
            return found
    if re.search(r"wave[\s_-]*number", plain):
        return Unit("wavenumber", word, 100.0)
    return Unit("unrecognised", word)


def _known(token: str, word: str) -> Unit | None:
    token = token.strip("()[]{}")
    if token in _NONE:
        return Unit("none", word)
    if _INDEX.fullmatch(token):
        return Unit("index", word)
    length = _nm_per(token)
    if length is not None:
        return Unit("length", word, length)
    if found := _WAVENUMBER.fullmatch(token):
        if found["plain"]:
            return Unit("wavenumber", word, 100.0)
        length = _nm_per(found["inverse"] or found["power"])
        return None if length is None else Unit("wavenumber", word, 1e9 / length)
    if found := _FREQUENCY.fullmatch(token):
        prefix = {"m": "mega", "p": "peta"}.get(found[1], found[1])
        return Unit("frequency", word, _PREFIXES[prefix])
    if found := _ENERGY.fullmatch(token):
        return Unit("energy", word, _PREFIXES[found[1]])
    return None


def _nm_per(token: str) -> float | None:
    token = token.replace("-", "")
    if found := _LENGTH.fullmatch(token):
        return _PREFIXES[found[1]] * 1e9
    return _OTHER_LENGTHS.get(token) or _OTHER_LENGTHS.get(token.removesuffix("s"))

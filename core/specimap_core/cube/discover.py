"""Find the cube among the variables of a container (HDF5, NetCDF, MATLAB, .npz), and the meaning of its axes."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from specimap_core.cube.model import readable_dtype
from specimap_core.cube.printable import printable
from specimap_core.cube.spectral_units import read_unit
from specimap_core.errors import CubeFormatError, CubeHeaderError
from specimap_core.notices import Notice, Notices

_CUBE_NAMES = ("cube", "reflectance", "hypercube", "spectra", "data", "image", "img", "hsi", "capture")
_REFLECTANCE = re.compile(r"refl|rfl|albedo", re.IGNORECASE)
# Beside a cube lie its references, its errors and its masks, mostly of the same shape.
_BESIDE = re.compile(
    r"(white|dark|black)(?![_ -]?(corr|sub|cal))|"
    r"(^|[^a-z])(refs?|err|std|unc|cov|var|noise|masks?|gt|rgb|obs)($|[^a-z])|"
    r"reference|panel|calibration|error|uncertain|stdev|sigma|flag|quality|geometr|label|preview|thumbnail|quicklook",
    re.IGNORECASE,
)
_WAVELENGTH_NAME = re.compile(
    r"wave|lambda|frequenc|(^|[^a-z])(wls?|wvls?|wn|freqs?)([^a-z]|$)|band_?cent|cent(er|re)s?_?of_?band",
    re.IGNORECASE,
)
# Names of vectors that are wavelengths where their unit is one of the spectrum's.
_SPECTRAL_NAME = re.compile(r"band|channel|energ|spectr|axis|(^|[^a-z])cw", re.IGNORECASE)
_NO_WAVELENGTH = re.compile(r"fwhm|width|uncert|err|std|flag|good|mask|resol|count|unit|range|index", re.IGNORECASE)
_BAND_AXIS_NAME = re.compile(r"wave|band|lambda|spectr|channel|freq|(^|_)wl($|_)", re.IGNORECASE)
_ACROSS_NAME = re.compile(r"x|cols?|columns?|samples?|lon(gitude)?|width|easting|across.*|pixels?", re.IGNORECASE)
_ALONG_NAME = re.compile(r"y|rows?|lines?|lat(itude)?|height|northing|along.*|scan.?lines?|frames?", re.IGNORECASE)
_UNITS_NAME = re.compile(r"units?", re.IGNORECASE)
_MOST_WAVELENGTHS = 1_000_000
_SHOWN = 8


@dataclass(frozen=True)
class Variable:
    """A variable as its container describes it: axes in the order in which they are stored.

    ``text`` is its content where that is one short string.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    axes: tuple[str, ...] = ()
    units: str | None = None
    text: str | None = None

    @property
    def short_name(self) -> str:
        """The name without the groups above it."""
        return self.name.rpartition("/")[2]

    def described(self) -> str:
        """Name and shape, with the axes' names where they have some: ``'L1/data' (y 512, x 640, band 61)``."""
        named = len(self.axes) == len(self.shape) and any(self.axes)
        axes = self.axes if named else ("",) * len(self.shape)
        sides = [f"{printable(axis)} {side}".strip() for axis, side in zip(axes, self.shape, strict=True)]
        return f"'{printable(self.name)}' ({', '.join(sides[:_SHOWN])}{', ...' if len(sides) > _SHOWN else ''})"


def choose_cube(path: Path, variables: Sequence[Variable], wanted: str | None = None) -> tuple[Variable, Notices]:
    """The variable with three axes, and a warning that names it where others could have been meant.

    Of several the one whose name says reflectance comes first, then the one whose name says cube, then the only one
    as long as the file's wavelengths; references, errors and masks come last. ``wanted`` is the name that the user
    gives. Raises CubeFormatError where there is none, or several and nothing tells; CubeHeaderError (``dtype``) where
    the only ones hold complex numbers or objects.
    """
    if wanted is not None:
        return _wanted(path, variables, wanted), ()
    solid = [v for v in variables if len(v.shape) == 3 and 0 not in v.shape and v.text is None]
    found = [v for v in solid if readable_dtype(v.dtype)]
    if solid and not found:
        raise _wrong_type(path, solid[0])
    if not found:
        raise _refusal(path, "no array with three axes", variables)
    if len(found) == 1:
        return found[0], ()
    chosen = _preferred(found, variables)
    if chosen is None:
        raise _refusal(path, "several arrays with three axes", found)
    beside = [v.described() for v in found if v is not chosen]
    others = ", ".join(beside[:_SHOWN]) + (", ..." if len(beside) > _SHOWN else "")
    text = f"{path.name} holds several arrays that could be the cube. {chosen.described()} was taken, not {others}."
    return chosen, (Notice("dataset_chosen", f"{text} On the command line --cube FILE::DATASET takes another."),)


def _wanted(path: Path, variables: Sequence[Variable], wanted: str) -> Variable:
    name = wanted.strip("/")
    named = (
        [v for v in variables if v.name.strip("/") == name]
        or [v for v in variables if v.name.strip("/").lower() == name.lower()]
        or [v for v in variables if v.short_name.lower() == name.lower()]
    )
    if len(named) != 1:
        what = "several arrays" if named else "no array"
        raise _refusal(path, f"{what} called '{printable(wanted)}'", named or variables)
    chosen = named[0]
    if not readable_dtype(chosen.dtype):
        raise _wrong_type(path, chosen)
    if len(chosen.shape) != 3 or 0 in chosen.shape:
        raise _refusal(path, f"{chosen.described()}, which has not three axes,", variables)
    return chosen


def _preferred(found: Sequence[Variable], variables: Sequence[Variable]) -> Variable | None:
    main = [v for v in found if not _BESIDE.search(v.name)] or list(found)
    if len(main) == 1:
        return main[0]
    reflecting = [v for v in main if _REFLECTANCE.search(v.name)]
    if len(reflecting) == 1:
        return reflecting[0]
    main = reflecting or main
    for name in _CUBE_NAMES:
        named = [v for v in main if v.short_name.lower() == name]
        if len(named) == 1:
            return named[0]
    counts = {max(v.shape) for v in _spectral_vectors(variables)}
    spectral = [v for v in main if counts & set(v.shape)]
    return spectral[0] if len(spectral) == 1 else None


def _wrong_type(path: Path, variable: Variable) -> CubeHeaderError:
    return CubeHeaderError(
        f"'{printable(variable.name)}' in {path.name} holds values of type {printable(str(variable.dtype))}.",
        advice="Save the cube as integers or real floating-point numbers.",
        field="dtype",
        value=printable(str(variable.dtype)),
    )


def _refusal(path: Path, what: str, variables: Sequence[Variable]) -> CubeFormatError:
    arrays = [v for v in variables if v.text is None]
    listed = ", ".join(v.described() for v in arrays[:_SHOWN]) + (", ..." if len(arrays) > _SHOWN else "")
    several = "Name the one that is the cube: --cube FILE::DATASET; or save it alone."
    alone = "Save one array of rows x columns x bands, named 'cube'."
    return CubeFormatError(
        f"{path.name} holds {what}{f': {listed}' if listed else ''}.",
        advice=several if sum(len(v.shape) == 3 for v in arrays) > 1 else alone,
        variables=[printable(v.name) for v in arrays[:20]],
        shapes=[list(v.shape[:_SHOWN]) for v in arrays[:20]],
    )


def choose_wavelengths(variables: Sequence[Variable], cube: Variable) -> Variable | None:
    """The vector whose name speaks of wavelengths; one as long as an axis of the cube, and near it, comes first.

    Its units are those that it states, else those of a text next to it, else those at the end of its name.
    """
    vectors = _spectral_vectors(variables)
    if not vectors:
        return None
    best = max(vectors, key=lambda v: (max(v.shape) in cube.shape, _groups_shared(v, cube)))
    if best.units is not None:
        return best
    stated = [
        v
        for v in variables
        if v.text is not None
        and _UNITS_NAME.search(v.short_name)
        and (_WAVELENGTH_NAME.search(v.short_name) or read_unit(v.text).kind not in ("none", "unrecognised"))
    ]
    nearest = max(stated, key=lambda v: _groups_shared(v, best), default=None)
    return replace(best, units=nearest.text if nearest else _units_in_name(best.short_name))


def arrays_beside(variables: Sequence[Variable], cube: Variable) -> list[Variable]:
    """Arrays of numbers in the cube's own group, the cube aside."""
    return [
        v
        for v in variables
        if _group(v) == _group(cube) and v.name != cube.name and v.text is None and readable_dtype(v.dtype)
    ]


def _spectral_vectors(variables: Sequence[Variable]) -> list[Variable]:
    vectors = [
        v
        for v in variables
        if v.shape
        and 1 <= math.prod(v.shape) == max(v.shape) <= _MOST_WAVELENGTHS
        and readable_dtype(v.dtype)
        and not _NO_WAVELENGTH.search(v.short_name)
    ]
    named = [v for v in vectors if _WAVELENGTH_NAME.search(v.short_name)]
    return named or [v for v in vectors if _SPECTRAL_NAME.search(v.short_name) and _has_spectral_unit(v)]


def _has_spectral_unit(variable: Variable) -> bool:
    unit = variable.units if variable.units is not None else _units_in_name(variable.short_name)
    return read_unit(unit).kind in ("length", "wavenumber", "frequency", "energy")


def _group(variable: Variable) -> str:
    return variable.name.rpartition("/")[0]


def _groups_shared(one: Variable, other: Variable) -> int:
    count = 0
    for a, b in zip(_group(one).split("/"), _group(other).split("/"), strict=False):
        if a != b:
            break
        count += 1
    return count


def _units_in_name(name: str) -> str | None:
    """The unit at the end of a name: ``wavelength_nm``, ``lambda (um)``, ``freq_THz``, ``wavenumber``."""
    plain = name.lower().replace("_", "")
    if "wavenumber" in plain or re.search(r"(^|_)wn($|_)", name.lower()):
        end = re.search(r"[_ (\[](1/c?m|c?m\^?-1)[)\]]?$", name)
        return end.group(1) if end else "cm-1"
    parts = [part for part in re.split(r"[_\s()\[\]]+", name) if part]
    if len(parts) > 1 and read_unit(parts[-1]).kind in ("length", "frequency", "energy", "index"):
        return parts[-1]
    return None


def cube_axes(
    cube: Variable, wavelengths: Variable | None, *, reversed_axes: bool
) -> tuple[tuple[int, int, int], Notices]:
    """Which stored axes are rows, columns and bands, and a warning where that was a guess.

    The band axis is the only one as long as the wavelengths, else the one named so, else the last one (the first
    where the writer stores axes reversed, as MATLAB 7.3 does).
    """
    usual = 0 if reversed_axes else 2
    named = [i for i, name in enumerate(cube.axes) if _BAND_AXIS_NAME.search(name)]
    count = max(wavelengths.shape) if wavelengths else None
    fitting = [i for i, side in enumerate(cube.shape) if side == count]
    warnings: Notices = ()
    if len(named) == 1 and (not fitting or named[0] in fitting):
        band = named[0]
    elif len(fitting) == 1:
        band = fitting[0]
        if len(named) == 1:
            text = f"The axes' names of {cube.described()} do not fit its {count} wavelengths"
            warnings = (Notice("axes_assumed", f"{text}; number {band} is taken as the bands'."),)
    else:
        band = usual if usual in fitting or not fitting else fitting[-1]
        text = f"Nothing tells which axis of '{printable(cube.name)}' {cube.shape} is the bands'; number {band} it is."
        warnings = (Notice("axes_assumed", text),)
    row, col = (i for i in range(3) if i != band)
    swapped = reversed_axes
    if len(cube.axes) == 3:
        one, other = cube.axes[row], cube.axes[col]
        if _ACROSS_NAME.fullmatch(one) and _ALONG_NAME.fullmatch(other):
            swapped = True
        elif _ALONG_NAME.fullmatch(one) and _ACROSS_NAME.fullmatch(other):
            swapped = False
    if swapped:
        row, col = col, row
    return (row, col, band), warnings

"""Which variable of a container (HDF5, NetCDF, MATLAB, .npz) is the cube, and which axis is which."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from specimap.core.cube.model import readable_dtype
from specimap.core.cube.wavelengths import Warnings
from specimap.core.errors import CubeFormatError, CubeHeaderError

_CUBE_NAMES = ("cube", "reflectance", "hypercube", "spectra", "data", "image", "img", "hsi", "capture")
_WAVELENGTH_NAME = re.compile(r"wave|lambda|(^|[^a-z])(wl|wvl)([^a-z]|$)|band_?cent", re.IGNORECASE)
_BAND_AXIS_NAME = re.compile(r"wave|band|lambda|spectr|channel|(^|_)wl($|_)", re.IGNORECASE)
_UNITS_IN_NAME = re.compile(r"[_ (](nm|um)\)?$", re.IGNORECASE)


@dataclass(frozen=True)
class Variable:
    """A variable as its container describes it: axes in the order in which they are stored."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    axes: tuple[str, ...] = ()
    units: str | None = None

    @property
    def short_name(self) -> str:
        """The name without the groups above it."""
        return self.name.rpartition("/")[2]


def choose_cube(path: Path, variables: Sequence[Variable]) -> Variable:
    """The variable with three axes; of several the one whose name says so.

    Raises CubeFormatError where there is none, or several and no name tells; CubeHeaderError (``dtype``)
    where the only ones hold complex numbers or objects.
    """
    solid = [v for v in variables if len(v.shape) == 3 and 0 not in v.shape]
    found = [v for v in solid if readable_dtype(v.dtype)]
    if solid and not found:
        raise CubeHeaderError(
            f"'{solid[0].name}' in {path.name} holds values of type {solid[0].dtype}.",
            advice="Save the cube as integers or real floating-point numbers.",
            field="dtype", value=str(solid[0].dtype),
        )  # fmt: skip
    if len(found) == 1:
        return found[0]
    for name in _CUBE_NAMES:
        named = [v for v in found if v.short_name.lower() == name]
        if len(named) == 1:
            return named[0]
    names = [v.name for v in found or variables]
    what = "several arrays with three axes" if found else "no array with three axes"
    raise CubeFormatError(
        f"{path.name} holds {what}.",
        advice="Save one array of rows x columns x bands, named 'cube'.",
        variables=names[:20],
    )


def choose_wavelengths(variables: Sequence[Variable], cube: Variable) -> Variable | None:
    """The vector whose name speaks of wavelengths; one as long as an axis of the cube comes first."""
    vectors = [
        v
        for v in variables
        if v.shape and math.prod(v.shape) == max(v.shape) and readable_dtype(v.dtype)
        and _WAVELENGTH_NAME.search(v.short_name)
    ]  # fmt: skip
    if not vectors:
        return None
    best = max(vectors, key=lambda v: max(v.shape) in cube.shape)
    return replace(best, units=_units_in_name(best.short_name)) if best.units is None else best


def _units_in_name(name: str) -> str | None:
    if "wavenumber" in name.lower().replace("_", ""):
        return "cm-1"
    found = _UNITS_IN_NAME.search(name)
    return found.group(1) if found else None


def cube_axes(
    cube: Variable, wavelengths: Variable | None, *, reversed_axes: bool
) -> tuple[tuple[int, int, int], Warnings]:
    """Which stored axes are rows, columns and bands, and a warning where that was a guess.

    The band axis is the one named so, else the one as long as the wavelengths, else the last one (the first
    where the writer stores axes reversed, as MATLAB 7.3 does).
    """
    usual = 0 if reversed_axes else 2
    named = [i for i, name in enumerate(cube.axes) if _BAND_AXIS_NAME.search(name)]
    count = max(wavelengths.shape) if wavelengths else None
    fitting = [i for i, side in enumerate(cube.shape) if side == count]
    warnings: Warnings = ()
    if len(named) == 1:
        band = named[0]
    elif len(fitting) == 1:
        band = fitting[0]
    else:
        band = usual if usual in fitting or not fitting else fitting[-1]
        text = f"Nothing tells which axis of '{cube.name}' {cube.shape} is the bands'; number {band} it is."
        warnings = (("axes_assumed", text),)
    row, col = (i for i in range(3) if i != band)
    across_first = len(cube.axes) == 3 and (cube.axes[row].lower(), cube.axes[col].lower()) == ("x", "y")
    if reversed_axes or across_first:
        row, col = col, row
    return (row, col, band), warnings

"""NetCDF3: scipy reads the header, the values are mapped."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.io import netcdf_file

from specimap_core.arrays import Array, Floats
from specimap_core.cube.declared_values import Declared, declared_of
from specimap_core.cube.discover import Variable, choose_cube, choose_wavelengths, cube_axes
from specimap_core.cube.model import Cube, describe
from specimap_core.cube.npy import starts_with
from specimap_core.cube.pixels import ArrayPixels

_LONGEST_UNITS = 64
_NETCDF3_MAGIC = (b"CDF\x01", b"CDF\x02")


class NetCdf3Format:
    """The variable with three axes, mapped; the axis called wavelength or band is the bands'."""

    name = "NetCDF3"
    suffixes: tuple[str, ...] = (".nc", ".cdf")
    stored_suffix: str | None = ".nc"

    def matches(self, path: Path) -> bool:
        return any(starts_with(path, magic) for magic in _NETCDF3_MAGIC)

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        with netcdf_file(path, "r", mmap=True) as file:
            variables = [
                Variable(name, tuple(v.shape), v.data.dtype, tuple(v.dimensions), _units(v), _content(name, v.data))
                for name, v in file.variables.items()
            ]
            cube, about_choice = choose_cube(path, variables, dataset)
            wavelengths = choose_wavelengths(variables, cube)
            values: Floats | None = None
            if wavelengths is not None:
                values = np.array(file.variables[wavelengths.name].data, np.float64).ravel()
            array = _remapped(path, file.variables[cube.name].data)
            declared = _declared(path, cube.name, vars(file.variables[cube.name])["_attributes"])
        axes, warnings = cube_axes(cube, wavelengths, reversed_axes=False)
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(axes)),
            wavelengths=values,
            units=wavelengths.units if wavelengths else None,
            declared=declared,
            warnings=about_choice + warnings,
        )


def _declared(path: Path, name: str, attributes: Mapping[str, object]) -> Declared:
    texts = {key: value.decode("utf-8", "replace") for key, value in attributes.items() if isinstance(value, bytes)}
    titles = (texts.get(title) for title in ("long_name", "standard_name", "units"))
    return declared_of(path.name, {**attributes, **texts}, name, *titles)


def _units(variable: object) -> str | None:
    stated = {name.lower(): value for name, value in vars(variable).items()}
    units = stated.get("units", stated.get("unit"))
    return units.decode("utf-8", "replace") if isinstance(units, bytes) else None


def _content(name: str, data: Array) -> str | None:
    """The text of a small variable of characters called units."""
    if "unit" in name.lower() and data.dtype.kind == "S" and data.size <= _LONGEST_UNITS:
        return data.tobytes().decode("utf-8", "replace")
    return None


def _remapped(path: Path, data: Array) -> Array:
    """The same bytes of the file through a map of our own: scipy's must be gone when its file closes."""
    base = data
    while isinstance(base.base, np.ndarray):
        base = base.base
    offset = data.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    whole = np.asarray(np.memmap(path, np.uint8, "r"))
    return np.ndarray(data.shape, data.dtype, buffer=whole, offset=offset, strides=data.strides)

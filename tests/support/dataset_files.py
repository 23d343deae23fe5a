"""Files of several arrays, each in a container of its own, and two arrays to tell apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy import io as scipy_io

from tests.support.cube_files import random_values

NM = np.linspace(400, 1000, 11)
COUNTS = random_values("u2")
SHARE = np.random.default_rng(3).random((7, 5, 11)).astype("f4")
Arrays = dict[str, Any]


def hdf5(folder: Path, arrays: Arrays) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        for name, values in arrays.items():
            f[name] = values
    return folder / "x.h5"


def netcdf4(folder: Path, arrays: Arrays) -> Path:
    """As netCDF4 writes it: groups, with dimension scales that name the axes."""
    with h5py.File(folder / "x.nc", "w") as f:
        for axis, size in (("line", 7), ("sample", 5), ("wavelength_axis", 11)):
            f[axis] = np.zeros(size, "f4")
            f[axis].make_scale(axis)
        for name, values in arrays.items():
            f[name] = values
            if np.ndim(values) == 3:
                for i, axis in enumerate(("line", "sample", "wavelength_axis")):
                    f[name].dims[i].attach_scale(f[axis])
    return folder / "x.nc"


def npz(folder: Path, arrays: Arrays) -> Path:
    np.savez(folder / "x.npz", **arrays)
    return folder / "x.npz"


def matlab5(folder: Path, arrays: Arrays) -> Path:
    scipy_io.savemat(folder / "x.mat", nested(arrays))
    return folder / "x.mat"


def nested(arrays: Arrays) -> Arrays:
    """``a/b`` as the field b of the struct a."""
    found: Arrays = {}
    for name, values in arrays.items():
        *groups, last = name.split("/")
        place = found
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = values
    return found


Writer = Callable[[Path, Arrays], Path]
CONTAINERS: list[Writer] = [hdf5, netcdf4, npz, matlab5]

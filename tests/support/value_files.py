"""Cubes of every format that say what their values mean, each in the words of its format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import tifffile

from specimap_core.arrays import Floats
from tests.support.cube_files import Values, write_envi

NM = np.linspace(400.0, 900.0, 6)


def listed(numbers: Floats) -> str:
    return "{" + ", ".join(repr(float(n)) for n in numbers) + "}"


def envi(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    output: dict[str, Any] = {"wavelength": listed(NM), "wavelength_units": "nm"}
    if no_data is not None:
        output["data_ignore_value"] = f"{no_data:g}"
    if gains is not None:
        output["data_gain_values"] = listed(gains)
    if offsets is not None:
        output["data_offset_values"] = listed(offsets)
    return write_envi(folder / "x.hdr", stored, "bil", **output)


def _attributes(no_data: float | None, gains: Floats | None, offsets: Floats | None) -> dict[str, object]:
    output = {"_FillValue": no_data, "scale_factor": gains, "add_offset": offsets}
    return {name: value for name, value in output.items() if value is not None}


def hdf5(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        f["cube"], f["wavelength"] = stored, NM
        f["cube"].attrs.update(_attributes(no_data, gains, offsets))
    return folder / "x.h5"


def netcdf4(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    with h5py.File(folder / "x.nc", "w") as f:
        f.create_dataset("cube", data=stored, chunks=(4, *stored.shape[1:]), compression="gzip")
        f["wavelength"] = NM
        output = _attributes(no_data, gains, offsets)
        output |= {"missing_value": np.array([output.pop("_FillValue")], stored.dtype)} if no_data is not None else {}
        f["cube"].attrs.update(output)
    return folder / "x.nc"


def netcdf3(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    with scipy.io.netcdf_file(folder / "x.cdf", "w") as f:
        for name, size in zip(("y", "x", "band"), stored.shape, strict=True):
            f.createDimension(name, size)
        variable = f.createVariable("cube", stored.dtype.str[1:], ("y", "x", "band"))
        variable[:] = stored
        for name, value in _attributes(no_data, gains, offsets).items():
            setattr(variable, name, value)
        f.createVariable("wavelength", "f8", ("band",))[:] = NM
    return folder / "x.cdf"


def _beside(no_data: float | None, gains: Floats | None, offsets: Floats | None) -> dict[str, object]:
    output = {"no_data": no_data, "scale_factor": gains, "add_offset": offsets, "wavelengths": NM}
    return {name: value for name, value in output.items() if value is not None}


def matlab5(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    scipy.io.savemat(folder / "x.mat", {"cube": stored, **_beside(no_data, gains, offsets)})
    return folder / "x.mat"


def matlab73(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    with h5py.File(folder / "y.mat", "w", userblock_size=512) as f:
        for name, value in {"cube": stored.T, **_beside(no_data, gains, offsets)}.items():
            f[name] = value if name == "cube" else np.atleast_2d(np.asarray(value, float))
            f[name].attrs["MATLAB_class"] = np.bytes_("double")
    return folder / "y.mat"


def npz(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    np.savez_compressed(folder / "x.npz", cube=stored, **_beside(no_data, gains, offsets))  # type: ignore[arg-type]
    return folder / "x.npz"


def tiff(folder: Path, stored: Values, no_data: float | None, gains: Floats | None, offsets: Floats | None) -> Path:
    """As GDAL writes it: an ASCII tag for no-data, XML for scale and offset of each sample."""
    tags: list[tuple[int, str, int, str, bool]] = []
    items = [
        f'<Item name="{role.upper()}" sample="{i}" role="{role}">{float(value)!r}</Item>'
        for role, values in (("scale", gains), ("offset", offsets))
        if values is not None
        for i, value in enumerate(np.broadcast_to(values, stored.shape[2]))
    ]
    if items:
        tags.append((42112, "s", 0, f"<GDALMetadata>{''.join(items)}</GDALMetadata>", False))
    if no_data is not None:
        tags.append((42113, "s", 0, f"{no_data:g}", False))
    tifffile.imwrite(
        folder / "x.tif", stored, photometric="minisblack", planarconfig="contig", metadata=None, extratags=tags
    )
    return folder / "x.tif"


Writer = Callable[[Path, Values, float | None, Floats | None, Floats | None], Path]
WRITERS: dict[str, Writer] = {
    "envi": envi,
    "hdf5": hdf5,
    "netcdf4": netcdf4,
    "netcdf3": netcdf3,
    "matlab5": matlab5,
    "matlab73": matlab73,
    "npz": npz,
    "tiff": tiff,
}

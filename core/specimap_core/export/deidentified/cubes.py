"""Cubes of any format as a plain ENVI pair: values, shape, wavelengths, bad bands, and nothing that a device said."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap_core.arrays import Array
from specimap_core.cube import Cube, open_cube

_TYPES = {"uint8": 1, "int16": 2, "int32": 3, "float32": 4, "float64": 5, "uint16": 12, "uint32": 13, "int64": 14}
_WIDER = {"int8": "int16", "bool": "uint8", "float16": "float32", "uint64": "float64"}
_BYTES_TOGETHER = 1 << 26


def clean_cube(source: Path, target: Path) -> None:
    """Write a cube as ``target`` (.hdr) and its values next to it (.bip), little-endian.

    Raises CubeHeaderError, CubeFormatError, CubeTruncatedError, as ``open_cube`` does.
    """
    cube = open_cube(source)
    name = cube.dtype.name
    kind = np.dtype(_WIDER.get(name, name if name in _TYPES else "float64")).newbyteorder("<")
    rows = max(1, _BYTES_TOGETHER // max(1, cube.cols * cube.bands * 8))
    with open(target.with_suffix(".bip"), "wb") as file:
        for start in range(0, cube.rows, rows):
            values: Array = cube.read_rows(start, min(start + rows, cube.rows))
            file.write(np.ascontiguousarray(values, kind).data)
    target.write_text(_header(cube, _TYPES[kind.name]), encoding="ascii")


def _header(cube: Cube, data_type: int) -> str:
    lines = [
        "ENVI",
        f"samples = {cube.cols}",
        f"lines = {cube.rows}",
        f"bands = {cube.bands}",
        "header offset = 0",
        "file type = ENVI Standard",
        f"data type = {data_type}",
        "interleave = bip",
        "byte order = 0",
    ]
    if np.isfinite(cube.wavelengths_nm).all():
        lines += ["wavelength units = Nanometers", _list("wavelength", [f"{nm:.6g}" for nm in cube.wavelengths_nm])]
    if cube.bad_bands.any():
        lines.append(_list("bbl", ["0" if bad else "1" for bad in cube.bad_bands]))
    if cube.to_reflectance is not None:
        lines.append(f"reflectance scale factor = {1.0 / cube.to_reflectance:.9g}")
    return "\n".join(lines) + "\n"


def _list(name: str, values: list[str]) -> str:
    return f"{name} = {{{', '.join(values)}}}"

"""Cubes that the tests write, and the check that every way of reading one gives its values."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from specimap_core.cube import Cube

Values = NDArray[Any]
ENVI_CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12, "u4": 13, "i8": 14, "u8": 15}
FILE_AXES = {"bip": (0, 1, 2), "bil": (0, 2, 1), "bsq": (2, 0, 1)}
DTYPES = sorted(ENVI_CODES)


def random_values(dtype: str, shape: tuple[int, int, int] = (7, 5, 11), seed: int = 0) -> Values:
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return (rng.normal(size=shape) * 1000).astype(dtype)
    info = np.iinfo(dtype)
    return rng.integers(info.min, info.max, shape, dtype=dtype, endpoint=True)


def write_envi(
    path: Path,
    values: Values,
    interleave: str = "bsq",
    *,
    order: Literal["<", ">"] = "<",
    offset: int = 0,
    compress: bool = False,
    drop: tuple[str, ...] = (),
    **extra: Any,
) -> Path:
    """Header ``path`` (.hdr) and its data; ``extra`` fields are added, with ``_`` for a space."""
    rows, cols, bands = values.shape
    dtype = values.dtype.newbyteorder(order)
    fields: dict[str, object] = {
        "samples": cols,
        "lines": rows,
        "bands": bands,
        "header offset": offset,
        "file type": "ENVI Standard",
        "data type": ENVI_CODES[values.dtype.str[1:]],
        "interleave": interleave,
        "byte order": int(order == ">"),
    }
    if compress:
        fields["file compression"] = 1
    fields |= {key.replace("_", " "): value for key, value in extra.items()}
    lines = [f"{key} = {value}" for key, value in fields.items() if key not in drop]
    path.write_text("\n".join(["ENVI", *lines]) + "\n")
    data = b"\xaa" * offset + values.transpose(FILE_AXES[interleave]).astype(dtype).tobytes()
    path.with_suffix(".raw").write_bytes(gzip.compress(data) if compress else data)
    return path


def check_reads(cube: Cube, values: Values) -> None:
    """Every way of reading gives ``values``, contiguous and native."""
    assert (cube.rows, cube.cols, cube.bands) == values.shape
    assert cube.dtype == values.dtype
    assert cube.dtype.isnative
    for start, stop in ((0, cube.rows), (cube.rows // 2, cube.rows // 2 + 1)):
        got = cube.read_rows(start, stop)
        assert got.dtype == values.dtype
        assert got.flags.c_contiguous
        assert got.flags.aligned
        np.testing.assert_array_equal(got, values[start:stop])
    last = cube.band(cube.bands - 1)
    assert last.dtype == values.dtype
    np.testing.assert_array_equal(last, values[..., -1])
    mean = cube.mean_image()
    assert mean.dtype == np.float32
    wide = values.astype(np.float64)
    # Sums of values of both signs cancel: the bound is float32 rounding of the largest term.
    np.testing.assert_allclose(mean, wide.mean(-1), rtol=1e-6, atol=2e-7 * float(np.abs(wide).max()))

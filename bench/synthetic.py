"""Full-size cubes made from the sample's: enlarged about the same centre, so that its markers show at their places."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.atomic import atomic_path, write_text
from specimap_core.cube import open_cube

ROWS, COLS, BANDS = 1024, 1280, 290
NOISE = 50
"""Standard deviation of the noise put on the values, reflectance * 10000: smooth spectra would compress too well."""
STRIP_ROWS = 64
SCALE = 10000

ENVI_TYPES = {"uint16": 12, "float32": 4}
_STRIP_AXES = {"bil": (1, 0, 2), "bip": (1, 2, 0)}


@dataclass(frozen=True)
class Enlarged:
    """``values`` (B, rows, cols) uint16, reflectance * 10000; ``wavelengths_nm`` (B,)."""

    values: NDArray[np.uint16]
    wavelengths_nm: NDArray[np.float64]


def enlarge(header: Path, rows: int = ROWS, cols: int = COLS, bands: int = BANDS) -> Enlarged:
    """The cube of ``header`` enlarged to fill the rows, its borders repeated to fill the columns, bands between its
    bands interpolated, with noise. Its centre stays the centre, so a camera's principal point does, too."""
    cube = open_cube(header)
    small = cube.read_rows(0, cube.rows).astype(np.float32)
    width = min(cols, round(cube.cols * rows / cube.rows / 2) * 2)
    side = (cols - width) // 2
    large = [
        cv2.copyMakeBorder(
            cv2.resize(np.ascontiguousarray(small[..., b]), (width, rows), interpolation=cv2.INTER_LINEAR),
            0,
            0,
            side,
            cols - width - side,
            cv2.BORDER_REPLICATE,
        )
        for b in np.flatnonzero(~_useless(small))
    ]
    rng = np.random.default_rng(0)
    noise = (NOISE * rng.standard_normal((2 * rows, cols), dtype=np.float32)).astype(np.float32)
    values = np.empty((bands, rows, cols), np.uint16)
    for b, place in enumerate(np.linspace(0, len(large) - 1, bands)):
        low = min(int(place), len(large) - 2)
        mixed = cv2.addWeighted(large[low], 1 - (place - low), large[low + 1], place - low, 0)
        shift = int(rng.integers(rows))
        values[b] = np.clip(mixed + noise[shift : shift + rows], 0, 65535)
    return Enlarged(values, np.linspace(cube.wavelengths_nm[0], cube.wavelengths_nm[-1], bands))


def write_envi_cube(cube: Enlarged, header: Path, dtype: str, interleave: str) -> None:
    """Write ``cube`` as an ENVI file of ``dtype`` (uint16, or float32 reflectance) and ``interleave``."""
    bands, rows, cols = cube.values.shape
    with atomic_path(header.with_suffix(".raw")) as aside, open(aside, "wb") as f:
        if interleave == "bsq":
            for band in cube.values:
                _as(band, dtype).tofile(f)
        else:
            for start in range(0, rows, STRIP_ROWS):
                strip = cube.values[:, start : start + STRIP_ROWS].transpose(_STRIP_AXES[interleave])
                _as(np.ascontiguousarray(strip), dtype).tofile(f)
    wavelengths = ", ".join(f"{w:.2f}" for w in cube.wavelengths_nm)
    scale = f"reflectance scale factor = {SCALE}\n" if dtype == "uint16" else ""
    write_text(
        header,
        f"ENVI\nsamples = {cols}\nlines = {rows}\nbands = {bands}\nheader offset = 0\nfile type = ENVI Standard\n"
        f"data type = {ENVI_TYPES[dtype]}\ninterleave = {interleave}\nbyte order = 0\n{scale}"
        f"wavelength units = nm\nwavelength = {{{wavelengths}}}\n",
    )


def _as(values: NDArray[np.uint16], dtype: str) -> NDArray[np.uint16] | NDArray[np.float32]:
    return values if dtype == "uint16" else values * np.float32(1 / SCALE)


def _useless(values: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Bands (B,) whose mean is far below their neighbours': they hold only noise."""
    mean = values.mean((0, 1))
    return np.asarray(mean < 0.3 * np.median(mean))

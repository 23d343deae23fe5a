"""Schema of a spectral cloud: its flags, its arrays, their layout and the order of its points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array

TILE = 16
CHUNK_POINTS = 256
SHARD_POINTS = 131072
SCALE_FACTOR = 1e-4
"""Stored value times this is reflectance, where nothing else is stated."""
NO_VALUE = 65535
"""Stored where there is no value, in clouds whose ``spectra`` have the attribute ``_FillValue``."""


class Flag(IntFlag):
    """Bits of a point's ``flags``."""

    SPECIMEN = 1
    MARKER_CARD = 2
    GRAZING = 4
    """The cube's ray meets the surface at more than 70 degrees from its normal."""
    SATURATED = 8
    """A good band reads as much as the sensor can, or more than can be stored."""
    DEPTH_INTERPOLATED = 16
    OCCLUDED = 32
    """Tissue stands between this place and the cube's camera: the spectrum is of the tissue in front (homography)."""
    UNDERCUT = 64
    """Other tissue stands above this place: top views and grids do not show it; the spectrum is its own (camera)."""
    NO_DATA = 128
    """A good band has no value: no-data, a dead detector element, no finite number; or all of them are zero."""


@dataclass(frozen=True, eq=False)
class CloudPoints:
    """The points of a cloud before they are written, in any order; a pixel has at most one point.

    ``hsi_pixel`` (S, 2) uint16 row, column in the cube; ``xyz`` (S, 3) float32 mm, marker frame; ``normal``
    (S, 3) float32 unit; ``rgb`` (S, 3) uint8; ``sigma_mm`` (S,) float32; ``flags`` (S,) uint8 of Flag's bits.
    """

    hsi_pixel: NDArray[np.uint16]
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    sigma_mm: NDArray[np.float32]
    flags: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.hsi_pixel)


class SpectraSource(Protocol):
    """Where the spectra come from: a cube on disk.

    ``wavelengths_nm`` (B,), NaN where unknown; ``bad_bands`` (B,); ``to_reflectance`` times a value is reflectance,
    None where the values are something else, which ``quantity`` names. A value that is not finite is none.
    ``saturation``: values from it on are saturated, (), (B,) or (cols, B); NaN or None where that is unknown.
    """

    @property
    def rows(self) -> int: ...
    @property
    def cols(self) -> int: ...
    @property
    def bands(self) -> int: ...
    @property
    def dtype(self) -> np.dtype: ...
    @property
    def to_reflectance(self) -> float | None: ...
    @property
    def quantity(self) -> str: ...
    @property
    def saturation(self) -> NDArray[np.float64] | None: ...
    @property
    def wavelengths_nm(self) -> NDArray[np.float64]: ...
    @property
    def bad_bands(self) -> NDArray[np.bool_]: ...

    def read_rows(self, start: int, stop: int) -> Array:
        """Values (stop - start, cols, bands), C-contiguous, native byte order."""


@dataclass(frozen=True)
class ArraySpec:
    """Layout of one array of the group; the first axis is the point (or band, or chunk)."""

    dtype: str
    dimensions: tuple[str, ...]
    width: int | None = None
    """Length of the second axis; None where the array has one axis, or where it is the band."""
    chunk_points: int = 4096
    units: str | None = None


# A query reads `xyz` around a place, a page of the viewer all of it: chunks of 4096 points serve both.
ARRAYS: dict[str, ArraySpec] = {
    "spectra": ArraySpec("uint16", ("point", "band"), chunk_points=CHUNK_POINTS),
    "xyz": ArraySpec("float32", ("point", "axis"), 3, units="mm"),
    "hsi_pixel": ArraySpec("uint16", ("point", "row_column"), 2),
    "normal": ArraySpec("float32", ("point", "axis"), 3),
    "rgb": ArraySpec("uint8", ("point", "channel"), 3),
    "sigma_mm": ArraySpec("float32", ("point",), units="mm"),
    "flags": ArraySpec("uint8", ("point",)),
    "wavelength_nm": ArraySpec("float32", ("band",), units="nm"),
    "chunk_aabb": ArraySpec("float32", ("chunk", "bound"), 6, units="mm"),
}


def tile_keys(pixels: NDArray[np.uint16]) -> NDArray[np.uint32]:
    """Position of the pixels (S, 2) row, column in the order of tiles: increasing, not consecutive."""
    row, col = pixels[:, 0].astype(np.uint32), pixels[:, 1].astype(np.uint32)
    # 12 + 12 bits of tile, 4 + 4 bits inside it: 16-bit pixels fill 32 bits exactly.
    return np.asarray((row >> 4) << 20 | (col >> 4) << 8 | (row & 15) << 4 | (col & 15), np.uint32)


def tile_order(pixels: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Indices (S,) that bring pixels (S, 2) into the order of 16x16 tiles.

    Tiles are row-major in the cube, pixels row-major in their tile; equal pixels keep their order.
    """
    return np.argsort(tile_keys(pixels), kind="stable")


def chunk_bounds(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bounding boxes (chunks, 6) mm, x y z minimum then maximum, of each 256 points of xyz (S, 3)."""
    starts = np.arange(0, len(xyz), CHUNK_POINTS)
    low, high = np.minimum.reduceat(xyz, starts), np.maximum.reduceat(xyz, starts)
    return np.concatenate([low, high], 1)

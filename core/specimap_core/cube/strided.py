"""Blocks of a cube in whatever order memory holds them: turned to BIP, or averaged over bands, in one pass.

A block is a *view* of shape (rows, cols, bands). Its strides tell how it is stored: bands contiguous (BIP),
cols contiguous (BIL, BSQ) or rows contiguous (what MATLAB and Fortran write). OpenCV's transpose and reduce
work on such views without a copy and are 4 to 8 times faster than numpy's strided loops.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array

# OpenCV's transpose only moves bytes: any element of the same size will do.
_CARRIER: dict[int, np.dtype] = {n: np.dtype(t) for n, t in ((1, "u1"), (2, "u2"), (4, "f4"), (8, "f8"))}
# Depths that cv2.reduce can sum, and the depth in which it does so.
_SUM_DEPTH = {"u1": cv2.CV_32F, "u2": cv2.CV_32F, "i2": cv2.CV_32F, "f4": cv2.CV_32F, "f8": cv2.CV_64F}
# Wider blocks than this many pixels fall out of the second-level cache while they are transposed.
_TRANSPOSE_PIXELS = 32768
# Above this many runs of wanted bands, gathering them first is cheaper than one reduction a run.
_MOST_RUNS = 16

Bands = NDArray[np.intp]


def native(dtype: np.dtype) -> np.dtype:
    """The same type in this machine's byte order."""
    return dtype.newbyteorder("=")


def rows_contiguous(block: Array) -> bool:
    """Whether neighbours in memory are neighbours down a column."""
    strides = [s if n > 1 else np.inf for s, n in zip(block.strides, block.shape, strict=True)]
    return bool(strides[0] < min(strides[1], strides[2]))


def _cols_contiguous(block: Array) -> bool:
    return block.strides[1] == block.itemsize and block.shape[1] > 1


def to_bip(block: Array) -> Array:
    """A block (n, cols, bands) of any memory order as a C-contiguous, aligned array in native byte order.

    A block that is so already comes back as it is, without a copy.
    """
    wanted = native(block.dtype)
    if block.flags.c_contiguous:
        return np.asarray(block) if block.dtype == wanted and block.flags.aligned else block.astype(wanted)
    if rows_contiguous(block):
        # First gather the rows asked for, which lie together in short runs, then turn them twice in cache.
        n, cols, bands = block.shape
        packed = block.transpose(2, 1, 0).copy(order="C").reshape(bands * cols, n)
        planes = np.empty((n, bands, cols), packed.dtype)
        _transpose(packed, planes.reshape(n, bands * cols))
        block = planes.transpose(0, 2, 1)
    if not _cols_contiguous(block):
        return np.ascontiguousarray(block, wanted)
    if not block.flags.aligned:
        block = block.copy(order="K")
    n, cols, bands = block.shape
    out = np.empty((n, cols, bands), block.dtype)
    step = _rows_in_one_matrix(block)
    for start in range(0, n, step):
        part = block[start : start + step]
        flat = part.transpose(2, 0, 1).reshape(bands, -1)  # a view: step was chosen so
        _transpose(flat, out[start : start + step].reshape(-1, bands))
    if block.dtype != wanted:
        return out.byteswap(inplace=True).view(wanted)
    return out


def _rows_in_one_matrix(block: Array) -> int:
    """How many rows of a block with contiguous cols make one (bands, rows * cols) matrix without a copy."""
    cols = int(block.shape[1])
    if block.strides[0] != cols * block.itemsize:
        return 1
    return max(1, _TRANSPOSE_PIXELS // cols)


def _transpose(source: Array, target: Array) -> None:
    carrier = _CARRIER[source.dtype.itemsize]
    done = cv2.transpose(source.view(carrier), target.view(carrier))
    if not np.may_share_memory(done, target):  # OpenCV made its own for a degenerate shape
        target.view(carrier)[...] = np.asarray(done).reshape(target.shape)


def band_runs(bands: Bands) -> list[slice]:
    """Sorted band indices (K,) as runs of neighbours."""
    breaks = np.flatnonzero(np.diff(bands) != 1) + 1
    return [slice(int(run[0]), int(run[-1]) + 1) for run in np.split(bands, breaks)]


def band_mean(block: Array, bands: Bands) -> NDArray[np.float32]:
    """Mean over ``bands`` (sorted indices, at least one) of a block (n, cols, bands), as (n, cols).

    NaN values are left out; a pixel with nothing else is NaN.
    """
    if block.dtype != native(block.dtype) or not block.flags.aligned:
        block = block.astype(native(block.dtype), order="K")
    if rows_contiguous(block):
        return np.ascontiguousarray(band_mean(block.transpose(1, 0, 2), bands).T)
    runs = band_runs(bands)
    if len(runs) > _MOST_RUNS:
        block, runs = block[:, :, bands], [slice(0, len(bands))]
        bands = np.arange(len(bands))
    n, cols, _ = block.shape
    total = np.empty((n, cols), np.float64 if block.dtype.itemsize > 2 else np.float32)
    step = _rows_in_one_matrix(block) if _cols_contiguous(block) else n
    for start in range(0, n, step):
        part = block[start : start + step]
        total[start : start + step] = sum(_band_sum(part[:, :, run]) for run in runs)
    mean = (total / np.float32(len(bands))).astype(np.float32)
    if block.dtype.kind == "f":
        holes = np.isnan(mean)
        if holes.any():
            mean[holes] = _mean_without_nan(block[holes][:, bands])
    return mean


def _band_sum(block: Array) -> Array:
    n, cols, bands = block.shape
    depth = _SUM_DEPTH.get(block.dtype.str[1:])
    if depth is None:
        return np.asarray(block.sum(-1, dtype=np.float64))
    if _cols_contiguous(block):
        return np.asarray(cv2.reduce(_planes(block), 0, cv2.REDUCE_SUM, dtype=depth)).reshape(n, cols)
    pixels = block.reshape(n * cols, bands)
    return np.asarray(cv2.reduce(pixels, 1, cv2.REDUCE_SUM, dtype=depth)).reshape(n, cols)


def _planes(block: Array) -> Array:
    return block.transpose(2, 0, 1).reshape(block.shape[2], -1)


def _mean_without_nan(spectra: Array) -> NDArray[np.float32]:
    known = ~np.isnan(spectra)
    count = known.sum(-1)
    total = np.where(known, spectra, 0).sum(-1, dtype=np.float64)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)

"""Room for values that must be unpacked before they can be read by rows."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

import numpy as np

from specimap_core.arrays import Array
from specimap_core.atomic import disk_errors

IN_MEMORY_BYTES = 256 << 20


def bytes_of(array: Array) -> memoryview:
    """The bytes of a one-dimensional array, to be filled."""
    return array.view(np.uint8).data


def scratch_array(shape: tuple[int, ...], dtype: np.dtype) -> Array:
    """An uninitialised array; a large one is mapped on an unnamed temporary file that vanishes with it.

    Raises StorageFullError where the temporary folder has no room.
    """
    size = math.prod(shape) * dtype.itemsize
    if size <= IN_MEMORY_BYTES:
        return np.empty(shape, dtype)
    with disk_errors(Path(tempfile.gettempdir())), tempfile.TemporaryFile(prefix="specimap-") as file:
        # Reserved now: running out while writing through the map would kill the process (SIGBUS).
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        return np.asarray(np.memmap(file, dtype, "r+", shape=shape))

"""The machine's own bound for a cube: reading its bytes, the codec on what is stored, writing what that gives."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numcodecs import blosc  # type: ignore[import-untyped]
from numpy.typing import NDArray

PIECE = 16 << 20


def bound_seconds(raw: Path, stored: NDArray[np.uint16], scratch: Path) -> dict[str, float]:
    """Seconds to read ``raw``, to compress ``stored`` as the cloud does (blosc lz4 5, bitshuffle), and to write the
    result into ``scratch``, each on every core. The file comes from the page cache, as in the measured run."""
    threads = os.cpu_count() or 1
    start = time.perf_counter()
    size = raw.stat().st_size
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(lambda at: _read(raw, at), range(0, size, PIECE)))
    read = time.perf_counter()
    flat = stored.reshape(-1)
    pieces = [flat[k : k + PIECE // 2] for k in range(0, len(flat), PIECE // 2)]
    blosc.set_nthreads(threads)
    packed = [blosc.compress(p, b"lz4", 5, blosc.BITSHUFFLE) for p in pieces]
    coded = time.perf_counter()
    with open(scratch, "wb") as f:
        for block in packed:
            f.write(block)
    written = time.perf_counter()
    scratch.unlink()
    return {"read_s": read - start, "codec_s": coded - read, "write_s": written - coded, "sum_s": written - start}


def _read(raw: Path, at: int) -> int:
    buffer = bytearray(PIECE)
    with open(raw, "rb", buffering=0) as f:
        f.seek(at)
        return f.readinto(buffer) or 0

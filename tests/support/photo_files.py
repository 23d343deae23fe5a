"""Photos' files as programs write them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from specimap_core.photos.reading import AcquisitionSettings

SETTINGS = AcquisitionSettings(working_px=160, least_photos=3)


def pattern(width: int = 120, height: int = 80, seed: int = 0) -> NDArray[np.uint8]:
    """Smooth colours, bright in the top left corner, so that a turn shows."""
    y, x = np.mgrid[:height, :width] / max(width, height)
    base = np.stack([1 - x, 1 - y, 0.5 + 0.2 * np.sin(9 * x)], -1) * 200
    return np.asarray(np.clip(base + np.random.default_rng(seed).normal(0, 6, base.shape), 0, 255), np.uint8)


def bomb(path: Path, side: int = 30000) -> Path:
    """A PNG of a few bytes that says it holds almost a billion pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 10_000)))
    return path


def written(path: Path, image: NDArray[np.uint8], kind: str, orientation: int | None = None, **options: Any) -> Path:
    """A photo in a format of Pillow's name."""
    exif = Image.Exif()
    if orientation:
        exif[ExifTags.Base.Orientation] = orientation
    picture = Image.fromarray(image)
    if kind == "MPO":
        options = {"save_all": True, "append_images": [picture.resize((30, 20))], **options}
    if kind in ("JPEG", "MPO", "HEIF", "WEBP", "AVIF"):
        options = {"quality": 95, **options}
    if kind != "BMP":
        # As bytes: for HEIF the writer then adds the rotation that readers go by, as phones do.
        options["exif"] = exif.tobytes()
    picture.save(path, kind, **options)
    return path

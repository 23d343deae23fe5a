"""File formats of photos: the one list that the folder's reader, the uploads and the documents share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PhotoFormat:
    """``suffix``: what a stored file of the format ends in. ``suffixes``: what such files may end in."""

    suffix: str
    media_type: str
    suffixes: tuple[str, ...]


FORMATS = {
    "JPEG": PhotoFormat(".jpg", "image/jpeg", (".jpg", ".jpeg", ".jpe", ".jfif", ".mpo")),
    "HEIF": PhotoFormat(".heic", "image/heic", (".heic", ".heif", ".hif")),
    "PNG": PhotoFormat(".png", "image/png", (".png",)),
    "TIFF": PhotoFormat(".tif", "image/tiff", (".tif", ".tiff")),
    "WEBP": PhotoFormat(".webp", "image/webp", (".webp",)),
    "AVIF": PhotoFormat(".avif", "image/avif", (".avif",)),
    "BMP": PhotoFormat(".bmp", "image/bmp", (".bmp",)),
}
"""By Pillow's name. Whatever a file is called, Pillow's other parsers (PostScript among them) do not get to see it."""
PHOTO_SUFFIXES = frozenset(suffix for known in FORMATS.values() for suffix in known.suffixes)
MEDIA_TYPES = {known.suffix: known.media_type for known in FORMATS.values()}
RAW_SUFFIXES = frozenset(
    {
        ".dng",
        ".nef",
        ".nrw",
        ".cr2",
        ".cr3",
        ".crw",
        ".arw",
        ".srf",
        ".sr2",
        ".orf",
        ".rw2",
        ".raf",
        ".pef",
        ".srw",
        ".x3f",
        ".3fr",
        ".erf",
        ".kdc",
        ".mrw",
    }
)
"""Sensor readings: colours, lens and noise are the software's that develops them, so no picture can be taken for
granted."""
NAMES = "JPEG, HEIC, PNG, TIFF, WebP, AVIF or BMP"


def suffix_of(pillow_format: str | None) -> str:
    """What a stored file of Pillow's format ends in; ``.bin`` for others."""
    # A JPEG with further pictures behind the first, as phones write for depth and brightness.
    known = FORMATS.get("JPEG" if pillow_format == "MPO" else pillow_format or "")
    return known.suffix if known else ".bin"

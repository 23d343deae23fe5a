"""Photos from their pixels alone: no EXIF, XMP, IPTC, maker notes, profile, comment, thumbnail or second picture."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from specimap_core.photos.decoding import decode_photo

QUALITY = 95
WHOLE = 1 << 30


def clean_photo(source: Path, target: Path) -> dict[str, object]:
    """Write a photo's pixels, upright and in sRGB, as a JPEG without anything else; return what is known of it.

    Raises:
        PhotoUnreadableError, PhotoRawError: it cannot be decoded.
    """
    decoded = decode_photo(source, WHOLE)
    picture = Image.fromarray(decoded.pixels)
    picture.save(target, "JPEG", quality=QUALITY, subsampling=0)
    stated = decoded.stated
    return {
        "name": target.name,
        "width_px": picture.width,
        "height_px": picture.height,
        "focal_35mm_mm": stated.focal_35mm,
        "digital_zoom": stated.digital_zoom,
    }


def clean_picture(source: Path, target: Path) -> None:
    """Write the pixels of a picture that the program drew, in the format of ``target``'s suffix."""
    with Image.open(source) as opened:
        pixels = opened.convert("RGBA" if opened.mode in ("RGBA", "LA", "P") else "RGB")
    # A new picture: one that was opened keeps what the file said beside its pixels.
    bare = Image.frombytes(pixels.mode, pixels.size, pixels.tobytes())
    if target.suffix == ".jpg":
        bare.convert("RGB").save(target, "JPEG", quality=QUALITY, subsampling=0)
    else:
        bare.save(target, "PNG")

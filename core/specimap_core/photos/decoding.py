"""One photo's file: decoded, turned upright, and what its EXIF states of camera and lens."""

from __future__ import annotations

import functools
import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError
from pillow_heif import register_heif_opener

from specimap_core.atomic import name_as_text
from specimap_core.errors import PhotoRawError, PhotoTooLargeError, PhotoUnreadableError
from specimap_core.photos.formats import FORMATS, NAMES, RAW_SUFFIXES, suffix_of

LARGEST_PHOTO_PIXELS = 250_000_000
LARGEST_PHOTO_BYTES = 1_600_000_000
QUARTER_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""Clockwise quarter turns by which an EXIF orientation is turned upright."""
TURNED_BY_READER = ("TIFF", "HEIF")
"""Formats whose reader turns the picture upright by itself, and gives its upright size before that."""
DRAFTED = ("JPEG", "MPO")
"""A JPEG decodes straight to a half or a quarter of its size where that is still large enough; for HEIF, a draft is the
thumbnail, which is another picture."""
STRIP_ROWS = 64
BIT_DEPTHS = (8, 10, 12, 14, 16)
DNG_VERSION = 50706
PHOTOMETRIC = 262
NEW_SUBFILE_TYPE = 254
SUB_IFDS = 330
CR2_MARK = b"CR"
SENSOR_PHOTOMETRICS = (32803, 34892)
"""A colour filter's mosaic, and linear sensor values."""
SAME_FOCAL = 1.08
"""Ratio up to which focal lengths are of one lens: a phone that refocuses zooms by about a per cent."""


@functools.cache
def set_up_pillow() -> None:
    """Let Pillow read HEIF, and leave the judging of sizes to :data:`LARGEST_PHOTO_PIXELS`, for the whole process.

    Pillow's own limit warns at 90 million pixels, which phones exceed, and on standard error.
    """
    register_heif_opener()
    Image.MAX_IMAGE_PIXELS = None


@dataclass(frozen=True)
class CameraStated:
    """What EXIF says of the camera; None where it says nothing. ``focal_35mm``: 35 mm equivalent, of the diagonal (CIPA
    DCG-001); ``focal_mm``: of the lens; ``digital_zoom``: 1 for none; ``subject_mm``: distance to the subject."""

    model: str | None = None
    focal_35mm: float | None = None
    focal_mm: float | None = None
    digital_zoom: float = 1.0
    subject_mm: float | None = None

    def contradiction(self, other: CameraStated) -> str | None:
        """Why the two cannot be one camera with one lens; None where nothing speaks against it."""
        if self.model and other.model and self.model != other.model:
            return f"was taken with {self.model}, the others with {other.model}: another camera"
        for own, others, what in (
            (self.focal_35mm, other.focal_35mm, "focal length (35 mm equivalent)"),
            (self.focal_mm, other.focal_mm, "focal length"),
        ):
            if own and others and not 1 / SAME_FOCAL < own / others < SAME_FOCAL:
                return f"has a {what} of {own:g} mm, the others {others:g} mm: another lens or zoom"
        if not 1 / SAME_FOCAL < self.digital_zoom / other.digital_zoom < SAME_FOCAL:
            return f"has a digital zoom of {self.digital_zoom:g}, the others {other.digital_zoom:g}: another zoom"
        return None

    def same_as(self, other: CameraStated) -> bool:
        """Whether EXIF says that both are of one camera with one lens."""
        comparable = bool(self.model and other.model) or bool(self.focal_35mm and other.focal_35mm)
        return comparable and self.contradiction(other) is None


@dataclass(frozen=True)
class Decoded:
    """``pixels`` (H, W, 3) sRGB uint8, upright, perhaps reduced; ``full_size`` (width, height) upright pixels of the
    file; ``quarter_turns``: by how many, clockwise, the pixels were turned from how the sensor read them; ``digest``:
    sha256 of the file."""

    pixels: NDArray[np.uint8]
    full_size: tuple[int, int]
    quarter_turns: int
    stated: CameraStated
    digest: str


def photo_suffix(path: Path) -> str:
    """What the photo ends in by its content.

    Raises:
        PhotoUnreadableError: it is of no known image format.
    """
    set_up_pillow()
    try:
        with Image.open(path, formats=tuple(FORMATS)) as opened:
            return suffix_of(opened.format)
    except Exception as error:
        # Not a list of types: on damaged files the decoders raise anything.
        raise _no_format() from error


def _no_format() -> PhotoUnreadableError:
    return PhotoUnreadableError(
        "The photo is of no known image format.", advice=f"Give a {NAMES} as the camera made it."
    )


def check_pixels(path: Path, most_whole: int) -> None:
    """Refuse a photo by its header, before it is decoded, if it has to be decoded whole and has too many pixels for it.

    A JPEG that is not progressive comes reduced, and may be larger.

    Raises:
        PhotoTooLargeError: it has more than ``most_whole`` pixels.
        PhotoUnreadableError: it is of no known image format.
    """
    set_up_pillow()
    try:
        with Image.open(path, formats=tuple(FORMATS)) as opened:
            (width, height), kind = opened.size, opened.format
            reduced = kind in DRAFTED and not opened.info.get("progressive")
    except Exception as error:
        raise _no_format() from error
    # More than that no way of decoding takes, which :func:`decode_photo` says.
    if most_whole < width * height <= LARGEST_PHOTO_PIXELS and not reduced:
        raise PhotoTooLargeError(
            f"{name_as_text(path)} has {width} x {height} pixels; of a {kind} file {most_whole / 1e6:g} million "
            "are decoded at most.",
            advice="Save it as a JPEG that is not progressive, or reduce it: 12 million pixels are plenty.",
            photo=name_as_text(path),
            limit_pixels=most_whole,
        )


def decode_photo(path: Path, least_px: int) -> Decoded:
    """Decode a photo, and turn it upright; a JPEG may come reduced, to no less than ``least_px`` along both sides.

    Raises:
        PhotoRawError: it holds a sensor's readings.
        PhotoUnreadableError: it cannot be read, is not one still image, is cut off, or is absurdly large.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        raise _raw(path)
    data = _bytes_of(path)
    set_up_pillow()
    try:
        with Image.open(io.BytesIO(data), formats=tuple(FORMATS)) as opened:
            return _decoded(opened, path, data, least_px)
    except PhotoUnreadableError:
        raise
    except Exception as error:
        # Not a list of types: on damaged files the decoders raise anything, ZeroDivisionError included.
        raise PhotoUnreadableError(
            f"{name_as_text(path)} does not decode as an image ({_reason(error)}).",
            advice="Copy the photo from the phone again, or take it again.",
            photo=name_as_text(path),
        ) from error


def _decoded(opened: Image.Image, path: Path, data: bytes, least_px: int) -> Decoded:
    width, height = opened.size
    if width * height > LARGEST_PHOTO_PIXELS:
        raise _unusable(path, f"has {width} x {height} pixels, more than any phone takes")
    exif = opened.getexif()
    if opened.format == "TIFF" and (data[8:10] == CR2_MARK or _of_a_sensor(exif)):
        raise _raw(path)
    several = _several(opened)
    if several:
        raise _unusable(path, several)
    if opened.format in DRAFTED:
        opened.draft("RGB", (least_px, least_px))
    details = exif.get_ifd(ExifTags.IFD.Exif)
    camera = _stated(exif, details)
    orientation = opened.info.get("original_orientation") or exif.get(ExifTags.Base.Orientation, 1)
    turns = QUARTER_TURNS.get(orientation, 0)
    by_reader = opened.format in TURNED_BY_READER
    opened.load()
    if not by_reader:
        ImageOps.exif_transpose(opened, in_place=True)
    if turns % 2 and not by_reader:
        width, height = height, width
    return Decoded(_eight_bit(opened), (width, height), turns, camera, hashlib.sha256(data).hexdigest())


def _of_a_sensor(exif: Image.Exif) -> bool:
    """Whether a TIFF is a raw file: it says so, or begins with a preview and holds the picture elsewhere."""
    if DNG_VERSION in exif or exif.get(PHOTOMETRIC) in SENSOR_PHOTOMETRICS:
        return True
    kind = exif.get(NEW_SUBFILE_TYPE, 0)
    return isinstance(kind, int) and bool(kind & 1) and SUB_IFDS in exif


def _several(opened: Image.Image) -> str:
    """Why a file is not one still image, '' where it is one. Small pages behind the first are previews."""
    frames = getattr(opened, "n_frames", 1)
    if opened.format in ("PNG", "WEBP", "AVIF") and frames > 1:
        return "is an animation, not a photo"
    if opened.format == "TIFF" and frames > 1:
        first = opened.size
        opened.seek(1)
        second = opened.size
        opened.seek(0)
        if second[0] * second[1] >= first[0] * first[1]:
            return f"holds {frames} pages, not one photo"
    return ""


def _bytes_of(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        if size > LARGEST_PHOTO_BYTES:
            raise _unusable(path, f"has {size / 1e9:.1f} GB, more than any photo")
        data = path.read_bytes()
    except OSError as error:
        raise PhotoUnreadableError(
            f"{name_as_text(path)} cannot be read ({error.strerror or error}).",
            advice="Let the account that runs Specimap read the photo.",
            photo=name_as_text(path),
        ) from error
    if not data:
        raise PhotoUnreadableError(
            f"{name_as_text(path)} is empty.",
            advice="Copy the photo from the phone again, or take it again.",
            photo=name_as_text(path),
        )
    return data


def _unusable(path: Path, why: str) -> PhotoUnreadableError:
    return PhotoUnreadableError(
        f"{name_as_text(path)} {why}.", advice="Give the photo as the phone made it.", photo=name_as_text(path)
    )


def _raw(path: Path) -> PhotoRawError:
    return PhotoRawError(
        f"{name_as_text(path)} is a raw file, the readings of a sensor: export it as JPEG.",
        advice="Export the raw files as JPEG, all with the same settings, not cropped.",
        photo=name_as_text(path),
    )


def _reason(error: Exception) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "no known image format"
    return str(error) or type(error).__name__


def _eight_bit(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith(("I", "F")):
        values = np.asarray(image)
        # Some rows at a time: as doubles, the whole would take eight times the memory, and several times the time.
        strips = [values[at : at + STRIP_ROWS] for at in range(0, len(values), STRIP_ROWS)]
        most = max((float(strip.max(initial=0, where=np.isfinite(strip))) for strip in strips), default=0.0)
        tops = [2.0**bits - 1 for bits in BIT_DEPTHS]
        top = 1.0 if image.mode.startswith("F") and most <= 1 else next((t for t in tops if most <= t), most)
        pixels = np.empty((*values.shape, 3), np.uint8)
        for k, strip in enumerate(strips):
            grey = np.clip(np.nan_to_num(strip.astype(float)) / top * 255, 0, 255).astype(np.uint8)
            pixels[k * STRIP_ROWS : (k + 1) * STRIP_ROWS] = grey[..., None]
        return pixels
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"), np.uint8)


def _stated(exif: Image.Exif, details: dict[int, object]) -> CameraStated:
    equivalent = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    subject = _number(details.get(ExifTags.Base.SubjectDistance))
    return CameraStated(
        model=_words(exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model)),
        focal_35mm=equivalent if equivalent and 8 < equivalent < 300 else None,
        focal_mm=_number(details.get(ExifTags.Base.FocalLength)),
        digital_zoom=_number(details.get(ExifTags.Base.DigitalZoomRatio)) or 1.0,
        subject_mm=subject * 1000 if subject and 0.02 < subject < 20 else None,
    )


def _words(make: object, model: object) -> str | None:
    """Make and model in printable characters; None without a model."""
    parts = ["".join(c for c in str(part) if c.isprintable()).strip()[:64] for part in (make, model) if part]
    return " ".join(parts) if model and parts[-1] else None


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None

"""What was captured: photos, upright and at a working size, each judged as it is read."""

from __future__ import annotations

import hashlib
import io
import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps, UnidentifiedImageError
from pillow_heif import register_heif_opener

from specimap.core.errors import NotFoundError, PhotoUnreadableError, TooFewPhotosError

register_heif_opener()

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif"})
PHOTO_FORMATS = ("JPEG", "PNG", "TIFF", "HEIF")
"""Whatever a file is called, Pillow's other parsers (PostScript among them) do not get to see it."""
LARGEST_PHOTO_PIXELS = 250_000_000
# Pillow's own limit warns at 90 million pixels, which phones exceed, and on standard error; photos are judged by
# the limit above before they are decoded.
Image.MAX_IMAGE_PIXELS = None
QUARTER_TURNS = {3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}
"""Clockwise quarter turns by which an EXIF orientation is turned upright."""
RECOMMENDED_PHOTOS = 20
FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)


@dataclass(frozen=True)
class AcquisitionSettings:
    """``working_px``: longer side that larger photos are brought to. ``least_photos``: fewer are refused."""

    working_px: int = 1280
    least_photos: int = 6


@dataclass(frozen=True)
class Photo:
    """A photo, upright by its EXIF.

    ``image`` (H, W, 3) sRGB uint8 at working size; ``full_size`` (width, height) upright pixels of the file;
    ``focal_px`` from EXIF in working pixels, None where there is none; ``subject_mm`` distance stated by EXIF;
    ``sharpness``: variance of the Laplacian over the variance of the image; ``digest``: sha256 of the file;
    ``quarter_turns``: by how many, clockwise, the pixels were turned from how the sensor read them.
    """

    name: str
    image: NDArray[np.uint8]
    full_size: tuple[int, int]
    focal_px: float | None
    subject_mm: float | None
    sharpness: float
    digest: str
    quarter_turns: int = 0

    def turned(self, quarter_turns: int) -> Photo:
        """The photo turned clockwise in its plane."""
        width, height = self.full_size
        return replace(
            self,
            image=np.ascontiguousarray(np.rot90(self.image, -quarter_turns)),
            full_size=(height, width) if quarter_turns % 2 else (width, height),
            quarter_turns=(self.quarter_turns + quarter_turns) % 4,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height at working size."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def grey(self) -> NDArray[np.uint8]:
        """(H, W) uint8."""
        return np.asarray(cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY), np.uint8)


def stated_focal_px(photos: list[Photo]) -> float | None:
    """Focal length in working pixels that most photos' EXIF states, None where most state none."""
    stated = [p.focal_px for p in photos if p.focal_px]
    return float(np.median(stated)) if len(stated) > len(photos) / 2 else None


@dataclass(frozen=True)
class Refusal:
    """A photo that is not used: its name, a stable code and the reason in a sentence."""

    name: str
    code: str
    reason: str


def photo_paths(folder: Path) -> list[Path]:
    """The photos in a folder by name; hidden files and other kinds of files are passed over.

    Raises:
        NotFoundError: there is no such folder.
        TooFewPhotosError: it holds no photo.
    """
    if not folder.is_dir():
        raise NotFoundError(f"There is no folder {folder}.", advice="Name the folder that holds the photos.")
    paths = sorted(
        p for p in folder.iterdir()
        if p.is_file() and p.suffix.lower() in PHOTO_SUFFIXES and not p.name.startswith(".")
    )  # fmt: skip
    if not paths:
        raise TooFewPhotosError(
            f"{folder} holds no photo.",
            advice=f"Photos end in {', '.join(sorted(PHOTO_SUFFIXES))}.",
            found=0,
        )
    return paths


def read_photo(path: Path, settings: AcquisitionSettings) -> Photo:
    """Decode one photo, turn it upright and bring it to working size.

    Raises:
        PhotoUnreadableError: it is not an image, is cut off, or is absurdly large.
    """
    try:
        data = path.read_bytes()
        with Image.open(io.BytesIO(data), formats=PHOTO_FORMATS) as opened:
            width, height = opened.size
            if width * height > LARGEST_PHOTO_PIXELS:
                raise PhotoUnreadableError(
                    f"{path.name} has {width} x {height} pixels, more than any phone takes.",
                    advice="Give the photo as the phone made it.",
                    photo=path.name,
                )
            exif = opened.getexif()
            # A JPEG decodes straight to a half or a quarter of its size where that is still large enough.
            opened.draft("RGB", (settings.working_px, settings.working_px))
            details = exif.get_ifd(ExifTags.IFD.Exif)
            turns = QUARTER_TURNS.get(exif.get(ExifTags.Base.Orientation, 1), 0)
            ImageOps.exif_transpose(opened, in_place=True)
            image = _eight_bit(opened)
    except PhotoUnreadableError:
        raise
    except Exception as error:
        # Not a list of types: on damaged files the decoders raise anything, ZeroDivisionError included.
        raise PhotoUnreadableError(
            f"{path.name} does not decode as an image ({_reason(error)}).",
            advice="Copy the photo from the phone again, or take it again.",
            photo=path.name,
        ) from error
    if turns % 2:
        width, height = height, width
    longer = max(image.shape[:2])
    if longer > settings.working_px:
        factor = settings.working_px / longer
        size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Photo(
        path.name, np.ascontiguousarray(image), (width, height),
        _focal_px(details, image.shape[1], image.shape[0]), _subject_mm(details), sharpness_of(image),
        hashlib.sha256(data).hexdigest(), turns,
    )  # fmt: skip


def _reason(error: Exception) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "no known image format"
    return str(error) or type(error).__name__


def _eight_bit(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith(("I", "F")):
        values = np.asarray(image, float)
        top = 65535.0 if values.max() > 255 else 255.0
        grey = np.clip(values / top * 255, 0, 255).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=2)
    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"), np.uint8)


def _focal_px(details: dict[int, object], width: int, height: int) -> float | None:
    """Focal length in pixels from the 35 mm equivalent, which refers to the diagonal (CIPA DCG-001)."""
    value = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    return value / FULL_FRAME_DIAGONAL_MM * math.hypot(width, height) if value and 8 < value < 300 else None


def _subject_mm(details: dict[int, object]) -> float | None:
    value = _number(details.get(ExifTags.Base.SubjectDistance))
    return value * 1000 if value and 0.02 < value < 20 else None


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def sharpness_of(image: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian over the variance of the grey image (H, W, 3); falls with blur."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var() / max(float(grey.var()), 1.0))


def read_photos(
    paths: list[Path],
    settings: AcquisitionSettings,
    *,
    workers: int = 2,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[list[Photo], list[Refusal]]:
    """Read photos; those that do not decode, or repeat another, are refused by name.

    Photos of one camera held upright and across come in two shapes. One lens for all wants one shape, and nothing
    later cares how a photo is rolled, so those of the rarer shape are turned by 90 degrees, back to how the sensor
    read them where EXIF tells. Photos of yet another size are foreign.

    Raises:
        PhotoUnreadableError: too few are left because photos do not decode.
        TooFewPhotosError: too few are left otherwise.
    """
    photos: list[Photo] = []
    refused: list[Refusal] = []

    def attempt(path: Path) -> Photo | Refusal:
        try:
            return read_photo(path, settings)
        except PhotoUnreadableError as error:
            return Refusal(path.name, error.code, error.message)

    seen: dict[str, str] = {}
    with ThreadPoolExecutor(workers) as pool:
        for done, result in enumerate(pool.map(attempt, paths), 1):
            if isinstance(result, Refusal):
                refused.append(result)
            elif result.digest in seen:
                refused.append(
                    Refusal(result.name, "photo_duplicate", f"It is the same file as {seen[result.digest]}.")
                )
            else:
                seen[result.digest] = result.name
                photos.append(result)
            progress(done / len(paths))
    photos, foreign = _of_one_shape(photos)
    refused += foreign
    if len(photos) < settings.least_photos:
        unreadable = [r for r in refused if r.code == PhotoUnreadableError.code]
        leaf = PhotoUnreadableError if unreadable else TooFewPhotosError
        raise leaf(
            f"{len(photos)} usable photos of {len(paths)}; at least {settings.least_photos} are needed."
            + (f" {unreadable[0].reason}" if unreadable else ""),
            advice=f"Take {RECOMMENDED_PHOTOS} or more photos all around the specimen, from 30 to 60 degrees up.",
            usable=len(photos),
            refused={r.name: r.reason for r in refused},
        )
    return photos, refused


def _of_one_shape(photos: list[Photo]) -> tuple[list[Photo], list[Refusal]]:
    """Turn photos into the shape that most have; refuse those of another size."""
    shapes = Counter(p.full_size for p in photos)
    if len(shapes) < 2:
        return photos, []
    # A camera's pictures count together, however it was held.
    usual = max(shapes, key=lambda s: (shapes[s] + shapes[s[::-1]] * (s[0] != s[1]), shapes[s]))
    turns = Counter(p.quarter_turns for p in photos if p.full_size == usual).most_common(1)[0][0]
    kept: list[Photo] = []
    refused: list[Refusal] = []
    for photo in photos:
        w, h = photo.full_size
        if (w, h) == usual:
            kept.append(photo)
        elif (h, w) == usual:
            by = (turns - photo.quarter_turns) % 4
            kept.append(photo.turned(by if by % 2 else 1))
        else:
            reason = f"It has {w} x {h} pixels, the others {usual[0]} x {usual[1]}: another camera."
            refused.append(Refusal(photo.name, "photo_foreign", reason))
    return kept, refused

"""Read photos, upright and at a working size; each is judged as it is read."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.atomic import name_as_text
from specimap_core.errors import PhotoRawError, PhotoUnreadableError, TooFewPhotosError
from specimap_core.photos.decoding import CameraStated, decode_photo
from specimap_core.photos.folder import photo_folder

RECOMMENDED_PHOTOS = 20
FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)
LEAST_SIDE_PX = 32
"""Of the shorter side at working size."""
SAME_ASPECT = 0.004
"""Relative difference up to which two sizes have one shape: three pixels of a photo that was reduced."""
MOST_ENLARGED = 2.0
"""A photo that must be enlarged more than this to match the others' working size blurs what they show."""


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
    ``quarter_turns``: by how many, clockwise, the pixels were turned from how the sensor read them; ``camera``: what
    EXIF says of it.
    """

    name: str
    image: NDArray[np.uint8]
    full_size: tuple[int, int]
    focal_px: float | None
    subject_mm: float | None
    sharpness: float
    digest: str
    quarter_turns: int = 0
    camera: CameraStated = field(default_factory=CameraStated)

    def turned(self, quarter_turns: int) -> Photo:
        """The photo turned clockwise in its plane."""
        width, height = self.full_size
        return replace(
            self,
            image=np.ascontiguousarray(np.rot90(self.image, -quarter_turns)),
            full_size=(height, width) if quarter_turns % 2 else (width, height),
            quarter_turns=(self.quarter_turns + quarter_turns) % 4,
        )

    def at_size(self, size: tuple[int, int]) -> Photo:
        """The photo at another working size (width, height) of the same shape."""
        if size == self.size:
            return self
        shrunk = size[0] < self.size[0]
        image = cv2.resize(self.image, size, interpolation=cv2.INTER_AREA if shrunk else cv2.INTER_CUBIC)
        focal = self.focal_px and self.focal_px * math.hypot(*size) / math.hypot(*self.size)
        return replace(self, image=np.asarray(image, np.uint8), focal_px=focal)

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


def read_photo(path: Path, settings: AcquisitionSettings) -> Photo:
    """Decode one photo, turn it upright and bring it to working size.

    Raises:
        PhotoUnreadableError: it is not an image, is cut off, or has absurdly many or few pixels.
        PhotoRawError: it holds a sensor's readings.
    """
    decoded = decode_photo(path, settings.working_px)
    image = decoded.pixels
    width, height = image.shape[1], image.shape[0]
    factor = min(settings.working_px / max(width, height), 1.0)
    size = round(width * factor), round(height * factor)
    if min(size) < LEAST_SIDE_PX:
        raise PhotoUnreadableError(
            f"{name_as_text(path)} has {decoded.full_size[0]} x {decoded.full_size[1]} pixels: too few to show "
            "anything.",
            advice="Give the photo as the phone made it.",
            photo=name_as_text(path),
        )
    if factor < 1:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    equivalent = decoded.stated.focal_35mm
    return Photo(
        name_as_text(path),
        np.ascontiguousarray(image),
        decoded.full_size,
        equivalent / FULL_FRAME_DIAGONAL_MM * math.hypot(*size) if equivalent else None,
        decoded.stated.subject_mm,
        sharpness_of(image),
        decoded.digest,
        decoded.quarter_turns,
        decoded.stated,
    )


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
    read them where EXIF tells. Where EXIF says that one camera took photos of several resolutions, all come to one
    working size. Photos of another camera, lens or zoom, and crops, are foreign.

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
            return Refusal(name_as_text(path), error.code, error.message)

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
    photos, foreign = of_one_camera(photos)
    refused += foreign
    if len(photos) < settings.least_photos:
        raise _too_few(paths, photos, refused, settings.least_photos)
    return photos, refused


def _too_few(
    paths: list[Path], photos: list[Photo], refused: list[Refusal], least: int
) -> PhotoUnreadableError | TooFewPhotosError:
    unreadable = [r for r in refused if r.code in (PhotoUnreadableError.code, PhotoRawError.code)]
    leaf: type[PhotoUnreadableError | TooFewPhotosError] = PhotoUnreadableError if unreadable else TooFewPhotosError
    advice = f"Take {RECOMMENDED_PHOTOS} or more photos all around the specimen, from 30 to 60 degrees up."
    if unreadable and all(r.code == PhotoRawError.code for r in unreadable):
        leaf, advice = PhotoRawError, "Export the raw files as JPEG, all with the same settings, not cropped."
    elif refused:
        advice = "Details give the reason for each photo. " + advice
    first = unreadable[:1] or refused[:1]
    passed_over = photo_folder(paths[0].parent).warnings() if paths else []
    return leaf(
        " ".join(
            [
                f"{len(photos)} usable photos of {len(paths)}; at least {least} are needed.",
                *(f"{r.name}: {r.reason}" for r in first),
                *(warning.message for warning in passed_over),
            ]
        ),
        advice=advice,
        usable=len(photos),
        refused={r.name: r.reason for r in refused},
    )


def of_one_camera(photos: list[Photo]) -> tuple[list[Photo], list[Refusal]]:
    """Photos at one working size, in the shape that most have; those of another camera, lens or zoom are refused."""
    if not photos:
        return [], []
    shapes = Counter(p.full_size for p in photos)
    # A camera's pictures count together, however it was held.
    usual = max(shapes, key=lambda s: (shapes[s] + shapes[s[::-1]] * (s[0] != s[1]), shapes[s], s[0] * s[1]))
    of_usual = [p for p in photos if p.full_size in (usual, usual[::-1])]
    camera = _usual_camera(of_usual)
    turns = Counter(p.quarter_turns for p in photos if p.full_size == usual).most_common(1)[0][0]
    size = Counter(p.size for p in photos if p.full_size == usual).most_common(1)[0][0]
    kept: list[Photo] = []
    refused: list[Refusal] = []
    for photo in photos:
        why = _foreign(photo, usual, size, camera)
        if why:
            refused.append(Refusal(photo.name, "photo_foreign", f"It {why}."))
            continue
        if usual[0] != usual[1] and (photo.full_size[0] > photo.full_size[1]) != (usual[0] > usual[1]):
            by = (turns - photo.quarter_turns) % 4
            photo = photo.turned(by if by % 2 else 1)
        kept.append(photo.at_size(size))
    return kept, refused


def _usual_camera(photos: list[Photo]) -> CameraStated:
    """What most of the photos state, each field by itself."""

    def most(values: list[float]) -> float | None:
        return Counter(values).most_common(1)[0][0] if values else None

    models = [p.camera.model for p in photos if p.camera.model]
    return CameraStated(
        model=Counter(models).most_common(1)[0][0] if models else None,
        focal_35mm=most([p.camera.focal_35mm for p in photos if p.camera.focal_35mm]),
        focal_mm=most([p.camera.focal_mm for p in photos if p.camera.focal_mm]),
        digital_zoom=most([p.camera.digital_zoom for p in photos]) or 1.0,
    )


def _foreign(photo: Photo, usual: tuple[int, int], size: tuple[int, int], camera: CameraStated) -> str | None:
    """Why a photo is not of the camera whose photos mostly have the ``usual`` size, ``size`` at work; None if it is."""
    contradiction = photo.camera.contradiction(camera)
    if contradiction or photo.full_size in (usual, usual[::-1]):
        return contradiction
    (w, h), (usual_w, usual_h) = photo.full_size, usual
    sizes = f"has {w} x {h} pixels, the others {usual_w} x {usual_h}"
    if not same_shape(photo.full_size, usual):
        return f"{sizes}: another camera, or a part cut out"
    if not photo.camera.same_as(camera):
        return f"{sizes}, and its EXIF does not say that the same camera took it"
    if max(size) > MOST_ENLARGED * max(photo.size):
        return f"{sizes}: too small beside them"
    return None


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes have the same ratio of longer to shorter side, however the camera was held."""
    return abs(max(size) * min(other) / (min(size) * max(other)) - 1) < SAME_ASPECT

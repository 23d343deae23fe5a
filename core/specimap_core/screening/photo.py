"""Photos: does one decode, is it sharp and well lit, and which markers does it show."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.errors import NoMarkersFoundError, PhotoUnreadableError, WrongDictionaryError
from specimap_core.fiducials.detection import Detection, detect_markers, fitting_dictionaries, shared_sightings
from specimap_core.photos.decoding import LARGEST_PHOTO_PIXELS, check_pixels, photo_suffix
from specimap_core.photos.reading import AcquisitionSettings, read_photo, same_shape
from specimap_core.screening.verdict import Verdict

LEAST_SIDE_PX = 240
"""Of the longer side: below it no marker in a usual view has the 7 pixels an edge needs."""
LEAST_MARKERS = 2
MOST_MARKERS = 64
"""Whose corners are told: the largest ones, of a printed board."""
# Measured at working size on 90 photos of phones, cameras and phantoms, sharp, defocused and shaken. Sharp ones have
# 0.0024 and more, and a third of their scene's median; defocused by two pixels, or shaken by 15, hardly one has 0.0012.
LEAST_SHARPNESS = 0.001
LEAST_SHARPNESS_OF_OTHERS = 0.2
LEAST_OTHERS = 3
# Edges lie in all directions: sharp and defocused photos have 0.25 and more, shaken ones mostly less than 0.2.
LEAST_ISOTROPY = 0.2
MOST_CLIPPED = 0.2
DARKEST_BRIGHT_END = 50

# Second derivatives along x, mixed, and along y; from their moments follow those along any direction.
_KERNELS = tuple(
    np.array(rows, np.float32)
    for rows in (((1, -2, 1),), ((0.25, 0, -0.25), (0, 0, 0), (-0.25, 0, 0.25)), ((1,), (-2,), (1,)))
)
_ANGLES = np.linspace(0, np.pi, 16, endpoint=False)
_ALONG = np.stack([np.cos(_ANGLES) ** 2, np.sin(2 * _ANGLES), np.sin(_ANGLES) ** 2], 1)
_CALMED_PX = 0.8
"""Below this the pixel grid itself prefers directions."""


@dataclass(frozen=True)
class Others:
    """The acquisition's accepted photos so far: their sharpness, and their (width, height)."""

    sharpness: Sequence[float] = ()
    sizes: Sequence[tuple[int, int]] = ()


def judge_photo(path: Path, dictionary: str, others: Others, most_pixels: int = LARGEST_PHOTO_PIXELS) -> Verdict:
    """Judge a photo. Facts: ``suffix`` by its format, ``width``, ``height``, ``sharpness``, ``clipped`` (the share
    that is overexposed), ``marker_ids``, ``markers`` with their corners in pixels of the upright photo,
    ``dictionary_seen`` where its markers are of another one.

    One of more than ``most_pixels`` that would have to be decoded whole is refused by its header.
    """
    facts: dict[str, Any] = {
        "suffix": ".bin",
        "width": None,
        "height": None,
        "sharpness": None,
        "clipped": None,
        "marker_ids": [],
        "markers": [],
        "dictionary_seen": None,
    }
    try:
        facts["suffix"] = photo_suffix(path)
        check_pixels(path, most_pixels)
        photo = read_photo(path, AcquisitionSettings())
    except PhotoUnreadableError as error:
        return Verdict("refused", error.code, error.message.replace(path.name, "The photo", 1), error.advice, facts)
    width, height = photo.full_size
    facts |= {"width": width, "height": height}
    if max(width, height) < LEAST_SIDE_PX:
        reason = f"It has {width} x {height} pixels; markers do not show in so few."
        return Verdict("refused", "photo_too_small", reason, "Give the photo as the phone made it.", facts)
    grey = photo.grey
    sharpness, isotropy = directional_sharpness(grey)
    found = detect_markers(grey, dictionary, expected=LEAST_MARKERS)
    ids = sorted({one.marker_id for one in found})
    clipped = float((photo.image.min(2) >= 254).mean())
    facts |= {"sharpness": round(sharpness, 6), "clipped": round(clipped, 4), "marker_ids": ids}
    facts["markers"] = _corners(found, max(width, height) / max(grey.shape))
    # One after the other: looking for markers of other dictionaries takes longer than all the rest.
    checks: tuple[Callable[[], Verdict | None], ...] = (
        lambda: _blurred(sharpness, isotropy, others.sharpness),
        lambda: _exposure(clipped, grey),
        lambda: _markers(ids, grey, dictionary),
        lambda: _foreign((width, height), others.sizes),
    )
    for check in checks:
        doubt = check()
        if doubt is not None:
            return Verdict(doubt.verdict, doubt.code, doubt.reason, doubt.advice, facts | doubt.facts)
    return Verdict(facts=facts)


def directional_sharpness(grey: NDArray[np.uint8]) -> tuple[float, float]:
    """Sharpness of (H, W) in its least sharp direction, and that over the one in its sharpest.

    Mean square of the second derivative along each of 16 directions, over the variance. Shaking blurs along one
    direction only, which the Laplacian does not notice.
    """
    calm = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _CALMED_PX)
    maps = np.stack([cv2.filter2D(calm, cv2.CV_32F, kernel).ravel() for kernel in _KERNELS])
    moments = (maps @ maps.T / maps.shape[1]).astype(float)
    energies = np.einsum("ki,ij,kj->k", _ALONG, moments, _ALONG) / max(float(grey.var()), 1.0)
    return float(energies.min()), float(energies.min() / max(energies.max(), 1e-12))


def _blurred(sharpness: float, isotropy: float, others: Sequence[float]) -> Verdict | None:
    usual = median(others) if len(others) >= LEAST_OTHERS else 0.0
    if sharpness < LEAST_SHARPNESS or isotropy < LEAST_ISOTROPY:
        reason = "It is shaken." if isotropy < LEAST_ISOTROPY else "It is out of focus."
    elif sharpness < LEAST_SHARPNESS_OF_OTHERS * usual:
        reason = "It is much less sharp than the other photos."
    else:
        return None
    return Verdict("doubtful", "photo_blurred", reason, "Take it again: hold still and tap on the specimen to focus.")


def _corners(found: Sequence[Detection], enlarged: float) -> list[dict[str, Any]]:
    """The largest markers with their corners in the file's pixels, which are ``enlarged`` times as many."""
    shown = sorted(sorted(found, key=lambda one: -one.edge_px)[:MOST_MARKERS], key=lambda one: one.marker_id)
    return [
        {"id": one.marker_id, "corners": np.round((one.corners_px + 0.5) * enlarged - 0.5, 2).tolist()} for one in shown
    ]


def _exposure(clipped: float, grey: NDArray[np.uint8]) -> Verdict | None:
    if clipped > MOST_CLIPPED:
        reason = f"{clipped:.0%} of it is overexposed."
        return Verdict("doubtful", "photo_overexposed", reason, "Take it again with less light or shorter exposure.")
    if float(np.percentile(grey, 95)) < DARKEST_BRIGHT_END:
        return Verdict("doubtful", "photo_underexposed", "It is too dark.", "Take it again with more light.")
    return None


def _markers(ids: list[int], grey: NDArray[np.uint8], dictionary: str) -> Verdict | None:
    if len(ids) >= LEAST_MARKERS:
        return None
    if ids:
        reason = f"Only marker {ids[0]} reads in it."
        return Verdict(
            "doubtful", "few_markers", reason, "Take it again with two or more markers whole in the picture."
        )
    # Twice at different sizes: texture that reads as a marker by chance does not do so again.
    # The smaller one first: where it shows nothing, the other is not searched.
    both = [np.asarray(cv2.resize(grey, None, fx=0.75, fy=0.75), np.uint8), grey]
    fitting = fitting_dictionaries(both)
    mirrored = shared_sightings([np.ascontiguousarray(image[:, ::-1]) for image in both], dictionary)
    # In dictionaries of few bits, mirror images of another one's markers read, too.
    if mirrored > max([LEAST_MARKERS, *fitting.values()]):
        reason = f"It is mirrored: markers of {dictionary} read in its mirror image only."
        advice = "Take it again with the phone's rear camera, and do not flip it."
        return Verdict("doubtful", NoMarkersFoundError.code, reason, advice)
    if fitting:
        seen = next(iter(fitting))
        reason = f"Its markers are of {seen}, the acquisition's of {dictionary}."
        advice = "Use the marker cards of the acquisition, or make an acquisition with that dictionary."
        return Verdict("doubtful", WrongDictionaryError.code, reason, advice, {"dictionary_seen": seen})
    advice = "Take it again with two or more markers whole in the picture, lit and not covered."
    return Verdict("doubtful", NoMarkersFoundError.code, f"No marker of {dictionary} reads in it.", advice)


def _foreign(size: tuple[int, int], others: Sequence[tuple[int, int]]) -> Verdict | None:
    """Photos of another camera's shape are left out of a job; held upright or across makes no difference, and neither
    does the resolution where EXIF names the same camera."""
    if len(others) < LEAST_OTHERS or any(same_shape(size, other) for other in others):
        return None
    (a, b), _ = Counter((max(other), min(other)) for other in others).most_common(1)[0]
    reason = f"It has {size[0]} x {size[1]} pixels, the others {a} x {b}: another camera, or a part cut out."
    return Verdict("doubtful", "photo_foreign", reason, "Take all photos with one camera at one setting; do not crop.")

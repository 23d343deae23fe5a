"""Square fiducial markers: finding them, and corners without bias to a few hundredths of a pixel.

``cv2.aruco`` decides which marker is where. Its corners are pulled toward the marker's centre by up to half a
pixel on gamma-encoded photos, so each corner is measured anew: the four edges of the square are located on
profiles across them in linear light, a line is fitted to each, and neighbouring lines are intersected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Bytes, Floats
from specimap_core.errors import UnknownDictionaryError
from specimap_core.fiducials.subpixel import UNMEASURED_PX, refine_corners
from specimap_core.fiducials.tone import TRIALS, shift_of_cells, tone_between
from specimap_core.photos.colour import linear_from_srgb

SMALLEST_EDGE_PX = 7.0
ENLARGED_PX = 1600
"""To be searched again a picture is enlarged at most to this, and at most twofold: in a large one markers are large."""
SHARPENED_PX = 1.5
TONE_PHOTOS = 8
"""Photos whose markers tell the tone of all."""
DICTIONARY_TRIALS = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
)


@dataclass(frozen=True)
class Detection:
    """One marker in one image.

    ``corners_px`` (4, 2): x, y of top-left, top-right, bottom-right, bottom-left of the upright marker, pixel
    centres at integers. ``sigma_px``: one standard deviation of a corner, from the scatter about the edges.
    """

    marker_id: int
    corners_px: Floats
    sigma_px: float

    @property
    def edge_px(self) -> float:
        """Mean length of the four edges in pixels."""
        return float(np.linalg.norm(self.corners_px - np.roll(self.corners_px, -1, 0), axis=1).mean())


def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined dictionary of that name.

    Raises:
        UnknownDictionaryError: there is none of that name.
    """
    return cv2.aruco.getPredefinedDictionary(dictionary_number(name))


def dictionary_number(name: str) -> int:
    """OpenCV's number of the dictionary of that name; raises as :func:`dictionary_named` does."""
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
        raise UnknownDictionaryError(
            f"There is no marker dictionary {name!r}.",
            advice=f"Use one of: {', '.join(known)}.",
            known=known,
        )
    return number


def _detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshWinSizeMin = 5
    parameters.adaptiveThreshWinSizeMax = 35
    parameters.adaptiveThreshWinSizeStep = 10
    parameters.minMarkerPerimeterRate = 0.02
    return cv2.aruco.ArucoDetector(dictionary_named(dictionary), parameters)


def detect_markers(
    grey: Bytes, dictionary: str, *, expected: int | None = None, linear: NDArray[np.float32] | None = None
) -> list[Detection]:
    """Find markers and measure their corners.

    Args:
        grey: (H, W) uint8, sRGB-encoded.
        dictionary: name of an OpenCV dictionary, e.g. ``DICT_4X4_50``.
        expected: where fewer than this many show, the image is searched again enlarged and sharpened, which
            finds small and defocused ones.
        linear: (H, W) linear light to measure the corners on; by default ``grey`` decoded.

    Returns: one Detection a marker seen; an id can stand twice where two markers carry it.
    """
    found = find_markers(grey, dictionary, expected=expected)
    return _measured(linear_from_srgb(grey) if linear is None else linear, found) if found else []


def find_markers(grey: Bytes, dictionary: str, *, expected: int | None = None) -> list[Detection]:
    """The markers that :func:`detect_markers` finds, their corners as OpenCV has them: not measured."""
    detector = _detector(dictionary)
    quads, ids, _ = detector.detectMarkers(grey)
    found = _collect([], quads, ids, (1.0, 1.0))
    if expected is None or len(found) < expected:
        scale = float(np.clip(ENLARGED_PX / max(grey.shape), 1.0, 2.0))
        big = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        sharp = cv2.addWeighted(big, 1.8, cv2.GaussianBlur(big, (0, 0), SHARPENED_PX * scale), -0.8, 0)
        quads, ids, _ = detector.detectMarkers(sharp)
        found = _collect(found, quads, ids, (big.shape[1] / grey.shape[1], big.shape[0] / grey.shape[0]))
    return [Detection(marker_id, corners, UNMEASURED_PX) for marker_id, corners in found]


def measured_at(grey: Bytes, detections: list[Detection], tone: float) -> list[Detection]:
    """The same markers, their corners measured anew in the linear light of ``grey`` (H, W) to the power ``tone``."""
    return _measured(linear_from_srgb(grey, tone), detections) if detections else []


def _measured(light: NDArray[np.float32], detections: list[Detection]) -> list[Detection]:
    refined = refine_corners(light, np.stack([d.corners_px for d in detections]))
    return [
        Detection(d.marker_id, corners, float(sigma)) for d, corners, sigma in zip(detections, *refined, strict=True)
    ]


def tone_of(greys: list[Bytes], detections: list[list[Detection]], dictionary: str, *, workers: int = 1) -> float:
    """The power of linear light (:mod:`specimap_core.fiducials.tone`) in which the edges of photos (H, W) of one camera
    lie where they are; ``detections``: what each of them shows."""
    number = dictionary_number(dictionary)

    def growths(photo: int, trial: float) -> Floats:
        if not detections[photo]:
            return np.zeros(0)
        light = linear_from_srgb(greys[photo], trial)
        found = _measured(light, detections[photo])
        return shift_of_cells(light, np.array([d.corners_px for d in found]), [d.marker_id for d in found], number)

    # Those that show most, and no more of them than it takes.
    order = sorted(range(len(greys)), key=lambda photo: -sum(d.edge_px for d in detections[photo]))[:TONE_PHOTOS]
    jobs = [(photo, trial) for trial in TRIALS for photo in order]
    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(lambda job: growths(*job), jobs))
    return tone_between([np.concatenate(found[k : k + len(order)]) for k in (0, len(order))]) if order else 1.0


def _collect(
    found: list[tuple[int, Floats]],
    quads: Sequence[Array],
    ids: NDArray[np.int32] | None,
    enlarged: tuple[float, float],
) -> list[tuple[int, Floats]]:
    """Add detections that are new: another id, or the same id a marker's width away."""
    found = list(found)
    for quad, marker_id in zip(quads, [] if ids is None else ids.ravel(), strict=True):
        corners = (quad.reshape(4, 2).astype(float) + 0.5) / np.array(enlarged) - 0.5
        edges = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
        if edges.min() < SMALLEST_EDGE_PX:
            continue
        centre = corners.mean(0)
        known = any(
            known_id == marker_id and np.linalg.norm(other.mean(0) - centre) < edges.mean() for known_id, other in found
        )
        if not known:
            found.append((int(marker_id), corners))
    return sorted(found, key=lambda pair: pair[0])


def fitting_dictionaries(images: list[Bytes]) -> dict[str, int]:
    """Dictionaries that do decode in ``images`` (each (H, W) uint8), with the sightings, most first, of ids
    that two images share.

    A name ends in the family's largest size; smaller members of the family hold its first ids.
    """
    votes: dict[str, int] = {}
    for name in DICTIONARY_TRIALS:
        votes[name] = shared_sightings(images, name)
    return dict(sorted(((n, v) for n, v in votes.items() if v), key=lambda pair: -pair[1]))


def shared_sightings(images: list[Bytes], dictionary: str) -> int:
    """Sightings of a dictionary's markers in ``images`` (each (H, W) uint8), of ids that two images share."""
    shown: Counter[int] = Counter()
    left = len(images)
    for image in images:
        ids = {d.marker_id for d in detect_markers(image, dictionary, expected=0)}
        shown.update(ids)
        # Where all images but one show nothing, two cannot share anything.
        left -= not ids
        if left < 2:
            return 0
    # Texture decodes as a marker now and then, but not twice as the same one.
    return sum(n for n in shown.values() if n >= 2)

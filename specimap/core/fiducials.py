"""Square fiducial markers: finding them, and corners without bias to a few hundredths of a pixel.

``cv2.aruco`` decides which marker is where. Its corners are pulled toward the marker's centre by up to half a
pixel on gamma-encoded photos, so each corner is measured anew: the four edges of the square are located on
profiles across them in linear light, a line is fitted to each, and neighbouring lines are intersected.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap.core.colour import linear_from_srgb
from specimap.core.errors import UnknownDictionaryError
from specimap.core.geometry import Array, Floats
from specimap.core.robust import SIGMA_OF_MAD

Bytes = NDArray[np.uint8]

PROFILES_PER_EDGE = 24
EDGE_MARGIN = 0.12
"""Share of an edge left out at either end, where the neighbouring edge blurs into the profile."""
SMALLEST_EDGE_PX = 7.0
DICTIONARY_TRIALS = (
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
)  # fmt: skip


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
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
        raise UnknownDictionaryError(
            f"There is no marker dictionary {name!r}.",
            advice=f"Use one of: {', '.join(known)}.",
            known=known,
        )
    return cv2.aruco.getPredefinedDictionary(number)


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
    detector = _detector(dictionary)
    quads, ids, _ = detector.detectMarkers(grey)
    found = _collect([], quads, ids, 1.0)
    if expected is None or len(found) < expected:
        big = cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        sharp = cv2.addWeighted(big, 1.8, cv2.GaussianBlur(big, (0, 0), 3), -0.8, 0)
        quads, ids, _ = detector.detectMarkers(sharp)
        found = _collect(found, quads, ids, 2.0)
    light = linear_from_srgb(grey) if linear is None else linear
    refined = (refine_corners(light, quad) for _, quad in found)
    return [
        Detection(marker_id, corners, sigma)
        for (marker_id, _), (corners, sigma) in zip(found, refined, strict=True)
    ]


def _collect(
    found: list[tuple[int, Floats]],
    quads: Sequence[Array],
    ids: NDArray[np.int32] | None,
    enlarged: float,
) -> list[tuple[int, Floats]]:
    """Add detections that are new: another id, or the same id a marker's width away."""
    found = list(found)
    for quad, marker_id in zip(quads, [] if ids is None else ids.ravel(), strict=True):
        corners = (quad.reshape(4, 2).astype(float) + 0.5) / enlarged - 0.5
        edges = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
        if edges.min() < SMALLEST_EDGE_PX:
            continue
        centre = corners.mean(0)
        known = any(
            known_id == marker_id and np.linalg.norm(other.mean(0) - centre) < edges.mean()
            for known_id, other in found
        )
        if not known:
            found.append((int(marker_id), corners))
    return sorted(found, key=lambda pair: pair[0])


def refine_corners(linear: NDArray[np.float32], corners: Floats) -> tuple[Floats, float]:
    """Corners (4, 2) as intersections of lines fitted to the square's edges in linear light (H, W).

    Returns the corners and one standard deviation of a corner in pixels. An edge that gives no clear profile
    (covered, out of the image) keeps the line through the corners it came with and a sigma of half a pixel.
    """
    sigma = 0.5
    for reach_share in (0.11, 0.08):  # the second pass starts close and sees less of the neighbourhood
        lines, errors = [], []
        for k in range(4):
            line, error = _fit_edge(linear, corners[k], corners[(k + 1) % 4], corners.mean(0), reach_share)
            lines.append(line)
            errors.append(error)
        crossed = np.stack([np.cross(lines[k - 1], lines[k]) for k in range(4)])
        moved = crossed[:, :2] / crossed[:, 2:]
        # A corner that runs away betrays an edge fitted to something else.
        limit = max(2.0, 0.15 * float(np.linalg.norm(corners[0] - corners[2])))
        if not np.isfinite(moved).all() or np.linalg.norm(moved - corners, axis=1).max() > limit:
            return corners, 0.5
        corners, sigma = moved, float(np.sqrt(2 * np.mean(np.square(errors))))
    return corners, sigma


def _fit_edge(
    linear: NDArray[np.float32], a: Floats, b: Floats, centre: Floats, reach_share: float
) -> tuple[Floats, float]:
    """The line (3,) with ``line @ (x, y, 1) = 0`` along the edge a-b, and its standard deviation in pixels."""
    along = b - a
    length = float(np.linalg.norm(along))
    along = along / length
    normal = np.array([along[1], -along[0]])
    if normal @ (centre - a) > 0:
        normal = -normal  # outward: from black into the white quiet zone
    fallback = np.array([*normal, -normal @ a]), 0.5
    # The dark border is one module wide (a sixth of the edge, or less in larger dictionaries), seen at a slant.
    thickness = abs(float(normal @ (centre - a))) * 2
    reach = float(np.clip(reach_share * thickness, 1.6, 8.0))
    s = np.linspace(EDGE_MARGIN, 1 - EDGE_MARGIN, PROFILES_PER_EDGE) * length
    d = np.arange(-reach, reach + 1e-6, 0.25)
    xy = a + s[:, None, None] * along + d[None, :, None] * normal
    height, width = linear.shape
    inside = ((xy >= 1) & (xy <= [width - 2, height - 2])).all(axis=(1, 2))
    if inside.sum() < PROFILES_PER_EDGE // 2:
        return fallback
    maps = xy[inside].astype(np.float32)
    profile = cv2.remap(linear, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC).astype(float)
    slope = np.gradient(profile, 0.25, axis=1)
    weight = np.clip(slope, 0, None)
    contrast = profile.max(1) - profile.min(1)
    clear = (contrast > 0.25 * np.median(contrast)) & (weight.sum(1) > 0)
    if clear.sum() < PROFILES_PER_EDGE // 2:
        return fallback
    weight = weight[clear]
    # Centroid of the slope in a window that is then centred on it: symmetric blur does not move it.
    position = d[weight.argmax(1)]
    half = max(1.2, 0.7 * reach)
    for _ in range(3):
        window = np.clip(1 - np.abs(d - position[:, None]) / half, 0, None)
        total = (weight * window).sum(1)
        position = np.where(total > 0, (weight * window * d).sum(1) / np.maximum(total, 1e-12), position)
    u, v = s[inside][clear], position
    keep = np.ones(len(u), bool)
    slope_fit, offset = 0.0, 0.0
    for _ in range(4):
        slope_fit, offset = np.polyfit(u[keep], v[keep], 1)
        residual = np.abs(v - (slope_fit * u + offset))
        keep = residual <= max(0.08, 2.5 * SIGMA_OF_MAD * float(np.median(residual[keep])))
        if keep.sum() < PROFILES_PER_EDGE // 3:
            return fallback
    p0 = a + normal * offset
    p1 = a + along * length + normal * (offset + slope_fit * length)
    n = np.array([p1[1] - p0[1], p0[0] - p1[0]])
    n = n / np.linalg.norm(n)
    scatter = float(np.std(v[keep] - (slope_fit * u[keep] + offset)))
    # Neighbouring profiles share pixels: about one independent measurement a pixel of edge; twice as wide at
    # the ends as in the middle, where a corner lies.
    return np.array([*n, -n @ p0]), max(0.01, 2 * scatter / np.sqrt(min(length, float(keep.sum()))))


def fitting_dictionaries(images: list[Bytes]) -> dict[str, int]:
    """Dictionaries that do decode in ``images`` (each (H, W) uint8), with the sightings, most first, of ids
    that two images share.

    A name ends in the family's largest size; smaller members of the family hold its first ids.
    """
    votes: dict[str, int] = {}
    for name in DICTIONARY_TRIALS:
        shown = Counter(i for image in images for i in {d.marker_id for d in detect_markers(image, name, expected=0)})
        # Texture decodes as a marker now and then, but not twice as the same one.
        votes[name] = sum(n for n in shown.values() if n >= 2)
    return dict(sorted(((n, v) for n, v in votes.items() if v), key=lambda pair: -pair[1]))

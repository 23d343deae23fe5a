"""Photos that markers do not reach: located by features against the photos that markers posed.

COLMAP's SIFT (Lowe 2004) is matched between neighbours in viewing angle, triangulated with the known poses, and a
photo without a pose is then resected by LO-RANSAC (COLMAP). Linear in the number of photos.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from specimap.core.acquisition import Photo
from specimap.core.geometry import Floats, Intrinsics, Pose, colmap_from_opencv, opencv_from_colmap
from specimap.core.reconstruct.depth import DepthSettings, choose_pairs

RATIO = 0.8
MOST_FEATURES = 2000
TRIANGULATION_PX = 2.0
RESECTION_PX = 4.0
NEAREST = 4
"""Photos that a photo with a rough pose is compared with, for each such pose."""
LEAST_INLIERS = 15
LEAST_INLIER_SHARE = 0.2


@dataclass(frozen=True)
class Features:
    """``xy`` (N, 2) pixels with centres at integers; ``descriptors`` (N, 128) float32."""

    xy: Floats
    descriptors: NDArray[np.float32]


@dataclass(frozen=True)
class Located:
    """A photo's resected pose with the number and share of matches that agree."""

    pose: Pose
    inliers: int
    share: float


# COLMAP reports every extractor it makes on standard error.
pycolmap.logging.minloglevel = pycolmap.logging.WARNING
# Importing COLMAP puts a handler of its own on SIGTERM, which prints a stack and ends the program; who runs this
# program may want to stop in order.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


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
    return Features(opencv_from_colmap(xy), unit.reshape(-1, 128))


def match(a: Features, b: Features) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test, (M, 2) indices."""
    if len(a.xy) < 2 or len(b.xy) < 2:
        return np.zeros((0, 2), np.int64)
    # Descriptors are of unit length, so distances follow from one matrix product.
    distance = np.sqrt(np.maximum(2 - 2 * (a.descriptors @ b.descriptors.T), 0))
    nearest = distance.argmin(1)
    rows = np.arange(len(distance))
    best = distance[rows, nearest]
    mutual = distance.argmin(0)[nearest] == rows
    distance[rows, nearest] = np.inf
    good = mutual & (best < RATIO * distance.min(1))
    return np.stack([rows[good], nearest[good]], -1)


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


class Locator:
    """Locates photos against those already posed."""

    def __init__(
        self, photos: list[Photo], lens: Intrinsics, poses: dict[int, Pose], target: Floats, seed: int
    ) -> None:
        self._photos = photos
        self._lens = lens
        self._target = target
        self._seed = seed
        self._features: dict[int, Features] = {}
        self._places: dict[int, Floats] = {}  # photo -> (N, 3), NaN where a feature has no place
        self.poses = dict(poses)

    def _ready(self, photos: Iterable[int]) -> None:
        missing = [p for p in photos if p not in self._features]
        with ThreadPoolExecutor(2) as pool:
            found = pool.map(extract, [self._photos[p] for p in missing])
            self._features.update(zip(missing, found, strict=True))

    def _place(self, photos: Iterable[int]) -> None:
        """Triangulate the features of posed photos with their neighbours, once."""
        order = tuple(sorted(self.poses))
        poses = tuple(self.poses[p] for p in order)
        new = [p for p in photos if p not in self._places]
        if not new:
            return
        pairs = [
            (order[i], order[j])
            for i, j in choose_pairs(poses, self._target, DepthSettings(pairs_per_photo=2))
            if order[i] in new
        ]
        self._ready({p for pair in pairs for p in pair} | set(new))
        for p in new:
            self._places[p] = np.full((len(self._features[p].xy), 3), np.nan)
        for a, b in pairs:
            self._triangulate(a, b)

    def _triangulate(self, a: int, b: int) -> None:
        pairs = match(self._features[a], self._features[b])
        if not len(pairs):
            return
        xy = self._features[a].xy[pairs[:, 0]], self._features[b].xy[pairs[:, 1]]
        points, good = triangulate_pair(self._lens, (self.poses[a], self.poses[b]), xy)
        self._places[a][pairs[good, 0]] = points[good]
        if b in self._places:
            self._places[b][pairs[good, 1]] = points[good]

    def near(self, poses: Iterable[Pose]) -> set[int]:
        """The posed photos that look from about where a photo with one of ``poses`` would."""
        known = np.array(sorted(self.poses))
        sights = np.stack([self._sight(self.poses[int(p)]) for p in known])
        return {int(p) for pose in poses for p in known[np.argsort(-(sights @ self._sight(pose)))[:NEAREST]]}

    def _sight(self, pose: Pose) -> Floats:
        away = pose.centre - self._target
        return np.asarray(away / np.linalg.norm(away))

    def locate(self, photo: int, among: set[int] | None = None) -> Located | None:
        """Resect a photo against the posed photos ``among``, all by default; None where too few matches agree."""
        others = set(self.poses) - {photo} if among is None else among - {photo}
        self._place(others)
        self._ready([photo])
        mine = self._features[photo]
        xy, places = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for other in sorted(others):
            known = self._places[other]
            pairs = match(mine, self._features[other])
            at = known[pairs[:, 1]]
            placed = np.isfinite(at).all(1)
            xy.append(mine.xy[pairs[placed, 0]])
            places.append(at[placed])
        points_2d, points_3d = np.concatenate(xy), np.concatenate(places)
        if len(points_2d) < LEAST_INLIERS:
            return None
        pycolmap.set_random_seed(self._seed)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = RESECTION_PX
        options.ransac.random_seed = self._seed
        answer = pycolmap.estimate_and_refine_absolute_pose(
            colmap_from_opencv(points_2d), points_3d, colmap_camera(self._lens), options
        )
        if answer is None:
            return None
        inliers = int(answer["num_inliers"])
        if inliers < LEAST_INLIERS or inliers < LEAST_INLIER_SHARE * len(points_2d):
            return None
        matrix = answer["cam_from_world"].matrix()
        return Located(Pose(matrix[:, :3].copy(), matrix[:, 3].copy()), inliers, inliers / len(points_2d))

    def add(self, photo: int, pose: Pose) -> None:
        """Count a photo as posed; its features take part from now on."""
        self.poses[photo] = pose

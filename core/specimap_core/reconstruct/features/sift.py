"""Image features behind one Protocol: what is found in a photo, and what two photos share.

SIFT (Lowe 2004) as COLMAP extracts it is the cheap kind; ALIKED with LightGlue, in a module of its own, the learned
one.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pycolmap

from specimap_core.geometry.colmap_cameras import opencv_from_colmap
from specimap_core.native import quiet_colmap
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.features.base import Features, Pairs, in_pool

RATIO = 0.8
MOST_FEATURES = 2000

# Importing COLMAP puts a handler of its own on SIGTERM, which prints a stack and ends the program; who runs this
# program may want to stop in order.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def extract(photo: Photo) -> Features:
    """SIFT features of a photo; a low peak threshold, since tissue is weakly textured."""
    quiet_colmap()
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
    # The largest of a column is found ten times faster than its place.
    mutual = alike.max(0)[nearest] == best
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

"""Photos at the resolution that they have: what shows nothing finer is brought to fewer pixels.

A photo that was enlarged, zoomed digitally, smoothed or taken out of focus has more pixels than it shows detail.
Patches that are compared pixel by pixel then hold too little to compare, and the mesh is as fine as the pixels: worse
and slower. A photo's resolution is measured at its markers, whose printed edges are sharp.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from specimap_core.fiducials.detection import Detection
from specimap_core.fiducials.subpixel import edge_blurs
from specimap_core.photos.colour import linear_from_srgb
from specimap_core.photos.reading import Photo

SHARP_PX = 0.5
"""Blur of an edge, one standard deviation, in a photo that resolves its pixels: 0.41 to 0.53 on phones and phantoms."""
LEAST_PX = 512
"""The longer side is not brought below this: fewer pixels are asked of no photo."""
WORTHWHILE = 0.9
SHARPEST = 0.25
"""A set resolves what its sharper photos do: this quantile of their blurs."""
LARGEST_CHANGE = 0.03
"""The longer side may differ by so much from what the blur says, so that both sides come to whole pixels."""


def own_resolution(photos: Sequence[Photo], detections: Sequence[list[Detection]], *, workers: int = 2) -> float:
    """Share of their pixels that photos of one camera need to hold what they show, at most 1."""

    def blur(photo: Photo, found: list[Detection]) -> float:
        squares = np.array([d.corners_px for d in found]).reshape(-1, 4, 2)
        blurs = edge_blurs(linear_from_srgb(photo.grey), squares) if found else np.zeros(0)
        blurs = blurs[np.isfinite(blurs)]  # none may be measurable where the photo is overexposed
        return float(np.median(blurs)) if blurs.size else float("nan")

    with ThreadPoolExecutor(workers) as pool:
        blurs = np.array(list(pool.map(blur, photos, detections)))
    known = blurs[np.isfinite(blurs)]
    if not len(known):
        return 1.0
    share = max(SHARP_PX / max(float(np.quantile(known, SHARPEST)), SHARP_PX), LEAST_PX / max(photos[0].size))
    return share if share < WORTHWHILE else 1.0


def at_own_resolution(
    photos: list[Photo], detections: list[list[Detection]], *, workers: int = 2
) -> tuple[list[Photo], list[list[Detection]]]:
    """Photos of one size, and what shows in them, brought to :func:`own_resolution`."""
    share = own_resolution(photos, detections, workers=workers) if photos else 1.0
    if share >= 1:
        return photos, detections
    width, height = photos[0].size
    size = _even_size(width, height, share)
    factor = np.array(size) / (width, height)

    def shrink(photo: Photo) -> Photo:
        image = np.asarray(cv2.resize(photo.image, size, interpolation=cv2.INTER_AREA), np.uint8)
        return replace(photo, image=image, focal_px=photo.focal_px and photo.focal_px * float(factor.mean()))

    with ThreadPoolExecutor(workers) as pool:
        shrunk = list(pool.map(shrink, photos))
    return shrunk, [
        [
            replace(d, corners_px=(d.corners_px + 0.5) * factor - 0.5, sigma_px=d.sigma_px * float(factor.mean()))
            for d in found
        ]
        for found in detections
    ]


def _even_size(width: int, height: int, share: float) -> tuple[int, int]:
    """Width and height near a ``share`` of the given that keep their ratio best: pixels are to stay square."""
    longer, shorter = max(width, height), min(width, height)
    near = np.arange(int(np.ceil(share * longer)), int(share * longer * (1 + LARGEST_CHANGE)) + 2)
    other = near * shorter / longer
    best = int(np.argmin(np.abs(other - np.rint(other)) / other))
    size = int(near[best]), int(np.rint(other[best]))
    return size if width >= height else size[::-1]

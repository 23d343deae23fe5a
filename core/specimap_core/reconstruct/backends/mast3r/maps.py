"""Depth maps in the marker frame from MASt3R's depths."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.errors import DepthNotFoundError
from specimap_core.geometry.cameras import Intrinsics
from specimap_core.geometry.depth_map import DepthMap, cropped_map
from specimap_core.reconstruct.backends.mast3r.metric import Metric, Predicted
from specimap_core.reconstruct.backends.mast3r.settings import PREFIX
from specimap_core.reconstruct.dense.volume import inside_volume, volume_over

EDGE_SHARE = 0.01
"""Neighbouring depths that differ by more than this share are two surfaces: nothing is interpolated between them."""


def depth_maps(
    predicted: Predicted,
    used: tuple[int, ...],
    metric: Metric,
    lens: Intrinsics,
    images: Bytes,
    least_confidence: float,
) -> tuple[DepthMap, ...]:
    """Depth of the photos ``used`` within the volume over the markers, mm; ``images`` (N, H, W, 3) and ``lens`` as the
    network sees them. Depth of at most ``least_confidence`` is dropped.

    Raises:
        DepthNotFoundError: nothing is left.
    """
    volume = volume_over(metric.corners, [metric.poses[p] for p in used])
    straight = replace(lens, k1=0.0, k2=0.0)
    maps = []
    for place, photo in enumerate(used):
        known, pose = metric.depths[photo], metric.poses[photo]
        if known is None:
            continue
        confidence = predicted.confidence[photo]
        sure = np.where(confidence > least_confidence, known, np.float32(0))
        depth, certain, colour = undistorted(lens, sure, bytes_of(confidence, least_confidence), images[photo])
        depth = inside_volume(depth, straight, pose.R, pose, volume)
        found = cropped_map(place, np.eye(3), straight, depth, colour, certain)
        if found is not None:
            maps.append(found)
    if not maps:
        raise DepthNotFoundError(
            "MASt3R is sure of no depth between the markers.",
            advice=f"Take sharper photos, with the specimen in the middle; or lower {PREFIX}CONFIDENCE.",
        )
    return tuple(maps)


def undistorted(lens: Intrinsics, depth: Singles, confidence: Bytes, colour: Bytes) -> tuple[Singles, Bytes, Bytes]:
    """The same as a lens without distortion sees them: depth along z does not change, its place does."""
    if not (lens.k1 or lens.k2):
        return depth, confidence, colour
    at = cv2.initUndistortRectifyMap(
        lens.matrix, lens.distortion, np.eye(3), lens.matrix, (lens.width, lens.height), cv2.CV_32FC1
    )
    nearest = cv2.remap(depth, *at, cv2.INTER_NEAREST)
    between = cv2.remap(depth, *at, cv2.INTER_LINEAR)
    whole = cv2.remap((depth > 0).astype(np.float32), *at, cv2.INTER_LINEAR) > 0.999
    smooth = whole & (np.abs(between - nearest) < EDGE_SHARE * nearest)
    return (
        np.where(smooth, between, nearest).astype(np.float32),
        np.asarray(cv2.remap(confidence, *at, cv2.INTER_NEAREST), np.uint8),
        np.asarray(cv2.remap(colour, *at, cv2.INTER_LINEAR), np.uint8),
    )


def bytes_of(confidence: Singles | Floats, least: float) -> Bytes:
    """Confidence from ``least`` to infinity as 1..255; it grows slowly, as the network's is unbounded."""
    share = 1 - least / np.maximum(confidence, least)
    return np.asarray(np.round(1 + 254 * share), np.uint8)

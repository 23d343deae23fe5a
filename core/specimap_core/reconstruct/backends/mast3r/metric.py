"""MASt3R's cameras and depths in millimetres: held to the markers, or as predicted.

MASt3R leaves focal length and distance uncertain together. Applying poses that were refined on the corners, with
another focal length, to depth that was found with MASt3R's own puts that depth in the wrong place: measured with exact
predictions, 1.4 mm for a focal length 1 % off. So by default cameras are adjusted here, and each photo's depth is
fitted to what the adjusted markers say of it. As published, neither is touched, and stage 2 keeps the focal length too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles
from specimap_core.bundle_adjust.adjust import Adjusted, AdjustSettings, adjust
from specimap_core.geometry.cameras import Intrinsics, Pose, View, rotation_from_vector
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.backends.depth_alignment import Alignment, align, depths_at, on_markers
from specimap_core.reconstruct.backends.marker_alignment import AlignedCameras
from specimap_core.reconstruct.backends.mast3r.images import Preparation

POINTS_PER_PHOTO = 400
LEAST_POINTS = 200


@dataclass(frozen=True)
class Predicted:
    """What MASt3R says, in network pixels and its own unit: ``lenses``, ``depth`` and ``confidence`` (N, H, W)."""

    lenses: tuple[Intrinsics, ...]
    depth: Singles
    confidence: Singles


@dataclass(frozen=True)
class Metric:
    """``lens``: the photos' shared lens; ``poses``: ``cam_from_world`` of all photos in the marker frame, mm;
    ``corners`` (Q, 4, 3) mm; ``depths``: each photo's (H, W) mm, None where nothing brings it there."""

    lens: Intrinsics
    poses: tuple[Pose, ...]
    corners: Floats
    depths: tuple[Singles | None, ...]


def as_predicted(lens: Intrinsics, placed: AlignedCameras, predicted: Predicted) -> Metric:
    """Cameras and depths as they are, but for frame and scale: as published, stage 2 then adjusts the poses alone.

    A photo that the markers had to place keeps no depth.
    """
    depths = tuple(
        None if photo in placed.resected else depth * np.float32(placed.scale)
        for photo, depth in enumerate(predicted.depth)
    )
    return Metric(lens, placed.poses, placed.corners, depths)


def hold_to_markers(
    lens: Intrinsics,
    placed: AlignedCameras,
    corners: CornersInPhotos,
    predicted: Predicted,
    plan: Preparation,
    least_confidence: float,
    *,
    edge_mm: float,
    seed: int,
) -> Metric:
    """Adjust the cameras on the corners and fit the depths.

    A photo without a marker is located by its own points, which the other photos' say how to move. A photo that the
    markers had to place keeps no depth.

    Raises:
        MarkerGeometryError: no marker is seen by two photos.
    """
    strange = np.isin(corners.seen.photo, list(placed.foreign))
    seen = corners.seen.of(~strange)
    adjusted = adjust(lens, placed.poses, seen, corners.marker_ids, AdjustSettings("rigid", edge_mm))
    network = network_lens(adjusted.lens, plan)
    confident = np.where(predicted.confidence > least_confidence, predicted.depth, np.float32(0))
    all_corners = _by_marker(adjusted, corners.marker_ids)
    fits: list[Alignment | None] = []
    for photo, pose in enumerate(adjusted.poses):
        if photo in placed.resected:
            # Depth was optimised along with a wrong pose: measured, tens of millimetres off away from the markers.
            fits.append(None)
            continue
        points = on_markers(all_corners, seen, photo)
        points = points[np.isfinite(points).all(1)]
        _, found, true = depths_at(points, View(network, pose), confident[photo])
        fits.append(align(found, true, seed=seed))
    poses = list(adjusted.poses)
    affine = _affine_to_markers(placed, predicted, confident, network, adjusted.poses, fits)
    if affine is not None:
        given_up = {*placed.foreign, *placed.resected}
        for photo in [p for p, fit in enumerate(fits) if fit is None and p not in given_up]:
            marked = bool((seen.photo == photo).any())
            poses[photo], fits[photo] = _pose_from_own_points(
                photo, placed, predicted, confident, network, poses[photo], affine, keep_pose=marked, seed=seed
            )
    depths = tuple(fit.apply(depth) if fit else None for fit, depth in zip(fits, predicted.depth, strict=True))
    return Metric(adjusted.lens, tuple(poses), adjusted.corners, depths)


def network_lens(lens: Intrinsics, plan: Preparation) -> Intrinsics:
    """The photo's lens in network pixels; the inverse of :meth:`Preparation.photo_lens`, with the distortion."""
    cx, cy = plan.to_network(np.array([lens.cx, lens.cy]))
    width, height = plan.size
    focal = lens.focal_px * float(np.sqrt(plan.scale.prod()))
    return replace(lens, width=width, height=height, focal_px=focal, cx=float(cx), cy=float(cy))


def _by_marker(adjusted: Adjusted, marker_ids: tuple[int, ...]) -> Floats:
    """Corners (Q, 4, 3) by the index of the marker; NaN for those without a place."""
    found = np.full((len(marker_ids), 4, 3), np.nan)
    for marker, square in zip(adjusted.marker_ids, adjusted.corners, strict=True):
        found[marker_ids.index(marker)] = square
    return found


def _pixels(confident: Singles) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of an even sample of the known depths."""
    rows, cols = np.nonzero(confident)
    step = max(1, len(rows) // POINTS_PER_PHOTO)
    return rows[::step], cols[::step]


def _world(lens: Intrinsics, pose: Pose, rows: NDArray[np.intp], cols: NDArray[np.intp], depth: Singles) -> Floats:
    cam = lens.rays(np.stack([cols, rows], -1).astype(float)) * depth[rows, cols, None]
    return pose.inverse().apply(cam)


def _affine_to_markers(
    placed: AlignedCameras,
    predicted: Predicted,
    confident: Singles,
    network: Intrinsics,
    poses: tuple[Pose, ...],
    fits: list[Alignment | None],
) -> Floats | None:
    """The affine map (4, 3) of MASt3R's placed points to those held to the markers; None where there are too few.

    A wrong focal length stretches what is seen, to first order evenly.
    """
    before, after = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for photo, fit in enumerate(fits):
        if fit is None or photo in placed.foreign:
            continue
        rows, cols = _pixels(confident[photo])
        scaled = predicted.depth[photo] * np.float32(placed.scale)
        before.append(_world(predicted.lenses[photo], placed.poses[photo], rows, cols, scaled))
        after.append(_world(network, poses[photo], rows, cols, fit.apply(predicted.depth[photo])))
    x, y = np.concatenate(before), np.concatenate(after)
    if len(x) < LEAST_POINTS:
        return None
    rows4 = np.column_stack([x, np.ones(len(x))])
    weight = np.ones(len(x))
    affine: Floats = np.zeros((4, 3))
    for _ in range(5):  # few rounds suffice: the outliers are background, far from the rest
        affine = np.asarray(np.linalg.lstsq(rows4 * weight[:, None], y * weight[:, None], rcond=None)[0], float)
        off = np.linalg.norm(rows4 @ affine - y, axis=1)
        weight = np.sqrt(1 / (1 + (off / max(2 * float(np.median(off)), 1e-6)) ** 2))
    return affine


def _pose_from_own_points(
    photo: int,
    placed: AlignedCameras,
    predicted: Predicted,
    confident: Singles,
    network: Intrinsics,
    pose: Pose,
    affine: Floats,
    *,
    keep_pose: bool,
    seed: int,
) -> tuple[Pose, Alignment | None]:
    """Pose and fit of a photo by its own points, moved as the others' moved."""
    rows, cols = _pixels(confident[photo])
    if len(rows) < LEAST_POINTS:
        return pose, None
    scaled = predicted.depth[photo] * np.float32(placed.scale)
    points = _world(predicted.lenses[photo], placed.poses[photo], rows, cols, scaled)
    points = np.column_stack([points, np.ones(len(points))]) @ affine
    if not keep_pose:
        start = cv2.Rodrigues(pose.R)[0], pose.t.reshape(3, 1).copy()
        good, rvec, tvec = cv2.solvePnP(
            points.reshape(-1, 1, 3),
            np.stack([cols, rows], -1).astype(float).reshape(-1, 1, 2),
            network.matrix,
            network.distortion,
            start[0],
            start[1],
            useExtrinsicGuess=True,
            flags=cv2.SOLVEPNP_ITERATIVE,
        )
        if good and np.isfinite(rvec).all() and np.isfinite(tvec).all():
            pose = Pose(rotation_from_vector(rvec.ravel()), tvec.ravel())
    z = pose.apply(points)[:, 2]
    return pose, align(predicted.depth[photo][rows, cols].astype(float), z, seed=seed)

"""Bring a network's cameras from their own frame and scale into the marker frame, by the corners that they see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import MarkerGeometryError, PhotosNotConnectedError
from specimap_core.fiducials.layout import edge_lengths, marker_frame
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Intrinsics, Pose, rotation_from_vector
from specimap_core.reconstruct.backend import CornersInPhotos

FOREIGN_SHARE_OF_WIDTH = 0.03
"""A photo whose markers miss their places by more than this share of its width is posed wrongly. A network's poses
leave some thousandths, a hundredth where it missed the focal length by a quarter; the adjustment takes that away."""
MOST_FOREIGN = 0.25


@dataclass(frozen=True)
class AlignedCameras:
    """``scale``: what the network's lengths were multiplied by to give mm. ``poses``: ``cam_from_world`` of all photos
    in the marker frame, mm; ``corners`` (Q, 4, 3) mm of the markers that two photos show; ``foreign``: photos that show
    the markers as no camera would, with their misfit in pixels. ``resected``: photos whose own pose the markers
    contradicted, and replaced; what the network measured along with that pose is as wrong as it was."""

    scale: float
    poses: tuple[Pose, ...]
    corners: Floats
    foreign: dict[int, float]
    resected: frozenset[int]


def align_to_markers(
    lens: Intrinsics, poses: tuple[Pose, ...], corners: CornersInPhotos, names: list[str], edge_mm: float
) -> AlignedCameras:
    """Place cameras of any frame and scale; ``poses`` and ``names`` of all photos, in their order.

    A pose that the markers contradict is solved from the markers.

    Raises:
        MarkerGeometryError: no marker is seen by two photos.
        PhotosNotConnectedError: the markers contradict the poses of many photos.
    """
    seen, foreign = corners.seen, dict[int, float]()
    while True:
        found = triangulate(lens, poses, seen, len(corners.marker_ids))
        known = np.asarray(np.isfinite(found).all(axis=(1, 2)), bool)
        if not known.any():
            raise MarkerGeometryError(
                "No marker is seen by two posed photos.", advice="Take more photos in which the same markers show."
            )
        misfit = _misfit(lens, poses, replace(corners, seen=seen.of(known[seen.marker])), found)
        worst = max(misfit, key=lambda p: misfit[p])
        if misfit[worst] <= FOREIGN_SHARE_OF_WIDTH * lens.width:
            break
        foreign[worst] = misfit[worst]
        if len(foreign) > MOST_FOREIGN * len(poses):
            raise PhotosNotConnectedError(
                f"The markers contradict how {len(foreign)} of {len(poses)} photos are placed.",
                advice="Give the photos of one unmoved scene; the details name those that stand apart.",
                photos=[names[p] for p in sorted(foreign)],
            )
        seen = seen.of(seen.photo != worst)
    strange = set(foreign)
    poses = _resected(lens, poses, corners, found, foreign)
    first = found[known]
    scale = edge_mm / float(np.median(edge_lengths(first)))
    scaled = tuple(Pose(p.R, p.t * scale) for p in poses)
    frame = marker_frame(scale * first, np.stack([p.centre for p in scaled]))
    back = frame.inverse()
    resected = frozenset(strange - set(foreign))
    return AlignedCameras(scale, tuple(p @ back for p in scaled), frame.apply(scale * first), foreign, resected)


def _resected(
    lens: Intrinsics, poses: tuple[Pose, ...], corners: CornersInPhotos, found: Floats, foreign: dict[int, float]
) -> tuple[Pose, ...]:
    """The poses with those that the markers contradict solved from the markers; ``foreign`` keeps what does not fit
    them at all. A single marker leaves two poses, and decides nothing."""
    posed = list(poses)
    known = np.asarray(np.isfinite(found).all(axis=(1, 2)), bool)
    for photo in list(foreign):
        seen = corners.seen.of((corners.seen.photo == photo) & known[corners.seen.marker])
        if len(seen.photo) < 2:
            continue
        places, pixels = found[seen.marker].reshape(-1, 1, 3), seen.corners_px.reshape(-1, 1, 2)
        good, rvec, tvec = cv2.solvePnP(places, pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_SQPNP)
        if not good:
            continue
        posed[photo] = Pose(rotation_from_vector(rvec.ravel()), tvec.ravel())
        left = _misfit(lens, tuple(posed), replace(corners, seen=seen), found)[photo]
        if left <= FOREIGN_SHARE_OF_WIDTH * lens.width:
            del foreign[photo]
        else:
            posed[photo] = poses[photo]
    return tuple(posed)


def _misfit(lens: Intrinsics, poses: tuple[Pose, ...], corners: CornersInPhotos, found: Floats) -> dict[int, float]:
    """Median distance in pixels between seen and projected corners, per photo; far for corners behind the camera."""
    seen = corners.seen
    apart = np.empty((len(seen.photo), 4))
    for k, (photo, marker) in enumerate(zip(seen.photo, seen.marker, strict=True)):
        cam = poses[int(photo)].apply(found[int(marker)])
        ahead = cam[:, 2] > 0
        miss = lens.project(np.where(ahead[:, None], cam, 1.0)) - seen.corners_px[k]
        apart[k] = np.where(ahead, np.linalg.norm(miss, axis=1), float(lens.width))
    return {int(p): float(np.median(apart[seen.photo == p])) for p in np.unique(seen.photo)}

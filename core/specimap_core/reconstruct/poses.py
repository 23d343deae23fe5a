"""Poses of the photos: from markers first, from features where markers do not reach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import PhotosNotConnectedError, TooFewPhotosError
from specimap_core.fiducials.layout import marker_frame
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.notices import Notices
from specimap_core.photos.reading import Photo, Refusal, stated_focal_px
from specimap_core.reconstruct.backend import CornersInPhotos, ReconstructSettings
from specimap_core.reconstruct.features.choice import check_features
from specimap_core.reconstruct.pose_check import outlier_photos
from specimap_core.reconstruct.poses_from_features import FeaturePoses, pose_by_resection, pose_by_structure_from_motion
from specimap_core.reconstruct.poses_from_markers import MarkerSolution, solve_from_markers

BLURRED_SHARE = 0.2
"""A photo whose sharpness is below this share of the median's is called blurred."""
FOREIGN_SHARE = 0.25
"""Where more of the photos than this contradict the rest, they are two scenes, not a few mistakes."""
LEAST_BY_MARKERS = 2
"""Photos that markers must pose for features to start from: triangulation takes two."""
SOLVED = 0.05
"""Progress when the markers are solved."""


@dataclass(frozen=True)
class Posed:
    """``photos``: indices of the posed photos, ascending; ``poses``: their ``cam_from_world`` in the marker frame, mm;
    ``corners`` (Q, 4, 3) mm of the markers; ``refused``: photos left out and why; ``warnings``: for the report."""

    photos: tuple[int, ...]
    lens: Intrinsics
    poses: tuple[Pose, ...]
    corners: Floats
    refused: tuple[Refusal, ...]
    warnings: Notices = ()


def pose_photos(
    photos: list[Photo],
    corners: CornersInPhotos,
    settings: ReconstructSettings,
    *,
    workers: int = 2,
    progress: Callable[[float], None] = lambda share: None,
) -> Posed:
    """Pose the photos and place the markers' corners. What ``progress`` raises ends the work.

    Raises:
        BackendUnavailableError: the features asked for are not installed.
        PhotosNotConnectedError: the photos show two scenes.
        TooFewPhotosError: fewer than three could be posed.
    """
    check_features(settings.features)
    progress(0.0)
    focal = stated_focal_px(photos)
    solution = corners.solution or solve_from_markers(
        corners.seen, corners.marker_ids, photos[0].size, edge_mm=settings.edge_mm, focal_px=focal
    )
    progress(SOLVED)
    _refuse_two_scenes(photos, solution)
    foreign = _foreign_photos(photos, solution)
    lens = solution.scene.lens
    poses, ambiguous, placed = _in_marker_frame(solution)
    certain = {p: pose for p, pose in poses.items() if p not in ambiguous}
    unposed = [p for p in range(len(photos)) if p not in certain and p not in foreign]
    by_features = FeaturePoses(certain, ())

    def so_far(share: float) -> None:
        progress(SOLVED + (1 - SOLVED) * share)

    if unposed and len(certain) >= LEAST_BY_MARKERS:
        by_features = pose_by_resection(
            photos,
            lens,
            certain,
            {p: (poses[p], ambiguous[p]) for p in ambiguous},
            unposed,
            placed,
            settings,
            workers=workers,
            progress=so_far,
        )
    elif unposed:
        by_motion = pose_by_structure_from_motion(
            photos, foreign, corners, focal, settings, workers=workers, progress=so_far
        )
        if by_motion is None:
            by_features = FeaturePoses(poses, ())
        else:
            by_features, lens, placed = by_motion
    outliers = outlier_photos(lens, by_features.poses, corners)
    used = tuple(sorted(set(by_features.poses) - set(outliers)))
    foreign |= {p: _foreign_refusal(photos[p], px) for p, px in outliers.items()}
    refused = (
        *foreign.values(),
        *_unposed_refusals(photos, [p for p in unposed if p not in by_features.poses], ambiguous),
    )
    if len(used) < 3:
        raise TooFewPhotosError(
            f"Only {len(used)} photos could be posed.",
            advice="Take more photos in which at least one marker shows wholly and sharply.",
            refused={r.name: r.reason for r in refused},
        )
    progress(1.0)
    return Posed(used, lens, tuple(by_features.poses[p] for p in used), placed, refused, by_features.warnings)


def _in_marker_frame(solution: MarkerSolution) -> tuple[dict[int, Pose], dict[int, Pose], Floats]:
    """Poses, the second poses of photos that one marker leaves ambiguous, and the corners."""
    frame = marker_frame(solution.scene.corners, np.stack([p.centre for p in solution.scene.poses]))
    back = frame.inverse()
    poses = {p: pose @ back for p, pose in zip(solution.photos, solution.scene.poses, strict=True)}
    ambiguous = {p: pose @ back for p, pose in solution.ambiguous.items()}
    return poses, ambiguous, frame.apply(solution.scene.corners)


def _refuse_two_scenes(photos: list[Photo], solution: MarkerSolution) -> None:
    """Raise PhotosNotConnectedError where many photos are foreign: two scenes. A few are left out later."""
    foreign = sorted([*solution.foreign, *solution.unconnected])
    if len(foreign) < max(3, FOREIGN_SHARE * len(photos)):
        return
    names = [photos[p].name for p in foreign]
    how = (
        "show the markers at other places than the rest"
        if len(solution.foreign) >= len(solution.unconnected)
        else "show no marker that the rest shows"
    )
    raise PhotosNotConnectedError(
        f"{len(names)} of {len(photos)} photos {how}: two scenes are mixed.",
        advice="Give the photos of one unmoved scene; the details name those that stand apart.",
        photos=names,
    )


def _foreign_photos(photos: list[Photo], solution: MarkerSolution) -> dict[int, Refusal]:
    """Refuse photos whose markers contradict the rest, or are none of the rest's."""
    foreign = {p: _foreign_refusal(photos[p], rms) for p, rms in solution.foreign.items()}
    return foreign | {
        p: Refusal(photos[p].name, "photo_foreign", "It shows markers, but none that the other photos show.")
        for p in solution.unconnected
    }


def _foreign_refusal(photo: Photo, px: float) -> Refusal:
    return Refusal(photo.name, "photo_foreign", f"Its markers stand {px:.0f} px from where the others show them.")


def _unposed_refusals(photos: list[Photo], unposed: list[int], ambiguous: dict[int, Pose]) -> list[Refusal]:
    usual = float(np.median([p.sharpness for p in photos]))
    return [_refusal(photos[p], p in ambiguous, photos[p].sharpness < BLURRED_SHARE * usual) for p in unposed]


def _refusal(photo: Photo, ambiguous: bool, blurred: bool) -> Refusal:
    if blurred:
        return Refusal(photo.name, "photo_blurred", "It is blurred: no marker reads, and nothing matches the others.")
    if ambiguous:
        return Refusal(
            photo.name, "photo_ambiguous", "Its single marker leaves two poses, and its features decide neither."
        )
    return Refusal(
        photo.name, "photo_unlocated", "It shows no marker that others show, and its features match no other photo."
    )

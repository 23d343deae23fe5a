"""Poses of the photos: from markers first, from features where markers do not reach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from specimap_core.errors import PhotosNotConnectedError, TooFewPhotosError
from specimap_core.fiducials.layout import marker_frame
from specimap_core.geometry.cameras import Floats, Intrinsics, Pose
from specimap_core.notices import Notices
from specimap_core.photos.reading import Photo, Refusal, stated_focal_px
from specimap_core.reconstruct.backend import CornersInPhotos, ReconstructSettings
from specimap_core.reconstruct.features.choice import check_features
from specimap_core.reconstruct.pose_check import strays
from specimap_core.reconstruct.poses_from_features import Reached, reach_by_motion, reach_by_places
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
    strange = _strange(photos, solution)
    lens = solution.scene.lens
    poses, weak, placed = _in_marker_frame(solution)
    sure = {p: pose for p, pose in poses.items() if p not in weak}
    waiting = [p for p in range(len(photos)) if p not in sure and p not in strange]
    reached = Reached(sure, ())

    def so_far(share: float) -> None:
        progress(SOLVED + (1 - SOLVED) * share)

    if waiting and len(sure) >= LEAST_BY_MARKERS:
        reached = reach_by_places(
            photos,
            lens,
            sure,
            {p: (poses[p], weak[p]) for p in weak},
            waiting,
            placed,
            settings,
            workers=workers,
            progress=so_far,
        )
    elif waiting:
        moved = reach_by_motion(photos, strange, corners, focal, settings, workers=workers, progress=so_far)
        if moved is None:
            reached = Reached(poses, ())
        else:
            reached, lens, placed = moved
    strayed = strays(lens, reached.poses, corners)
    used = tuple(sorted(set(reached.poses) - set(strayed)))
    strange |= {p: _elsewhere(photos[p], px) for p, px in strayed.items()}
    refused = (*strange.values(), *_left_out(photos, [p for p in waiting if p not in reached.poses], weak))
    if len(used) < 3:
        raise TooFewPhotosError(
            f"Only {len(used)} photos could be posed.",
            advice="Take more photos in which at least one marker shows wholly and sharply.",
            refused={r.name: r.reason for r in refused},
        )
    progress(1.0)
    return Posed(used, lens, tuple(reached.poses[p] for p in used), placed, refused, reached.warnings)


def _in_marker_frame(solution: MarkerSolution) -> tuple[dict[int, Pose], dict[int, Pose], Floats]:
    """Poses, the other poses of photos with one marker, and the corners."""
    frame = marker_frame(solution.scene.corners, np.stack([p.centre for p in solution.scene.poses]))
    back = frame.inverse()
    poses = {p: pose @ back for p, pose in zip(solution.photos, solution.scene.poses, strict=True)}
    weak = {p: pose @ back for p, pose in solution.weak.items()}
    return poses, weak, frame.apply(solution.scene.corners)


def _refuse_two_scenes(photos: list[Photo], solution: MarkerSolution) -> None:
    """A few foreign photos are left out later; many are a second scene, and which one is meant is not ours to say."""
    strange = sorted([*solution.foreign, *solution.unconnected])
    if len(strange) < max(3, FOREIGN_SHARE * len(photos)):
        return
    names = [photos[p].name for p in strange]
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


def _strange(photos: list[Photo], solution: MarkerSolution) -> dict[int, Refusal]:
    """Photos whose markers contradict the rest, or are none of the rest's."""
    foreign = {p: _elsewhere(photos[p], rms) for p, rms in solution.foreign.items()}
    return foreign | {
        p: Refusal(photos[p].name, "photo_foreign", "It shows markers, but none that the other photos show.")
        for p in solution.unconnected
    }


def _elsewhere(photo: Photo, px: float) -> Refusal:
    return Refusal(photo.name, "photo_foreign", f"Its markers stand {px:.0f} px from where the others show them.")


def _left_out(photos: list[Photo], open_photos: list[int], weak: dict[int, Pose]) -> list[Refusal]:
    usual = float(np.median([p.sharpness for p in photos]))
    return [_why(photos[p], p in weak, photos[p].sharpness < BLURRED_SHARE * usual) for p in open_photos]


def _why(photo: Photo, weak: bool, blurred: bool) -> Refusal:
    if blurred:
        return Refusal(photo.name, "photo_blurred", "It is blurred: no marker reads, and nothing matches the others.")
    if weak:
        return Refusal(
            photo.name, "photo_ambiguous", "Its single marker leaves two poses, and its features decide neither."
        )
    return Refusal(
        photo.name, "photo_unlocated", "It shows no marker that others show, and its features match no other photo."
    )

"""Poses of the photos: from markers first, from features where markers do not reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap.core.acquisition import Photo, Refusal
from specimap.core.errors import PhotosNotConnectedError, TooFewPhotosError
from specimap.core.geometry import Floats, Intrinsics, Pose
from specimap.core.layout import marker_frame
from specimap.core.reconstruct.backend import CornersInPhotos, ReconstructSettings
from specimap.core.reconstruct.features import Locator
from specimap.core.reconstruct.markers import MarkerSolution, solve_from_markers

BLURRED_SHARE = 0.2
"""A photo whose sharpness is below this share of the median's is called blurred."""
FOREIGN_SHARE = 0.25
"""Where more of the photos than this contradict the rest, they are two scenes, not a few mistakes."""
SAME_POSE_DEG = 8.0


@dataclass(frozen=True)
class Posed:
    """``photos``: indices of the posed photos, ascending; ``poses``: their ``cam_from_world`` in the marker frame, mm;
    ``corners`` (Q, 4, 3) mm of the markers; ``refused``: photos left out and why; ``remarks``: (code, sentence)."""

    photos: tuple[int, ...]
    lens: Intrinsics
    poses: tuple[Pose, ...]
    corners: Floats
    refused: tuple[Refusal, ...]
    remarks: tuple[tuple[str, str], ...] = ()


def pose_photos(photos: list[Photo], corners: CornersInPhotos, settings: ReconstructSettings) -> Posed:
    """Pose the photos and place the markers' corners.

    Raises:
        PhotosNotConnectedError: the photos show two scenes.
        TooFewPhotosError: fewer than three could be posed.
    """
    focal = [p.focal_px for p in photos if p.focal_px]
    solution = solve_from_markers(
        corners.seen,
        corners.marker_ids,
        photos[0].size,
        edge_mm=settings.edge_mm,
        focal_px=float(np.median(focal)) if len(focal) > len(photos) / 2 else None,
    )
    _refuse_two_scenes(photos, solution)
    frame = marker_frame(solution.scene.corners, np.stack([p.centre for p in solution.scene.poses]))
    back = frame.inverse()
    poses = {p: pose @ back for p, pose in zip(solution.photos, solution.scene.poses, strict=True)}
    placed = frame.apply(solution.scene.corners)
    weak = {p: pose @ back for p, pose in solution.weak.items()}
    poses, refused = _reach_the_rest(photos, solution, poses, weak, placed, settings.seed)
    used = tuple(sorted(poses))
    if len(used) < 3:
        raise TooFewPhotosError(
            f"Only {len(used)} photos could be posed.",
            advice="Take more photos in which at least one marker shows wholly and sharply.",
            refused={r.name: r.reason for r in refused},
        )
    return Posed(used, solution.scene.lens, tuple(poses[p] for p in used), placed, tuple(refused))


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


def _reach_the_rest(
    photos: list[Photo],
    solution: MarkerSolution,
    poses: dict[int, Pose],
    weak: dict[int, Pose],
    corners: Floats,
    seed: int,
) -> tuple[dict[int, Pose], list[Refusal]]:
    """Locate photos without a marker by features, and settle those whose single marker leaves two poses."""
    refused = [
        Refusal(photos[p].name, "photo_foreign", f"Its markers stand {rms:.0f} px from where the others show them.")
        for p, rms in solution.foreign.items()
    ] + [
        Refusal(photos[p].name, "photo_foreign", "It shows markers, but none that the other photos show.")
        for p in solution.unconnected
    ]
    strange = {*solution.foreign, *solution.unconnected}
    sure = {p: pose for p, pose in poses.items() if p not in weak}
    open_photos = [p for p in range(len(photos)) if p not in sure and p not in strange]
    if not open_photos:
        return sure, refused
    if len(sure) < 2:
        return poses, refused
    # The specimen lies inside the layout, about a fifth of its size above the plane.
    target = corners.reshape(-1, 3).mean(0) + np.array([0, 0, 0.1 * np.ptp(corners[..., 0])])
    locator = Locator(photos, solution.scene.lens, sure, target, seed)
    waiting, moved = list(open_photos), True
    while waiting and moved:
        moved = False
        for photo in list(waiting):
            among = locator.near((poses[photo], weak[photo])) if photo in weak else None
            located = locator.locate(photo, among)
            if located is None:
                continue
            pose = located.pose
            if photo in weak:
                pose = min((poses[photo], weak[photo]), key=lambda p: _angle_deg(p, located.pose))
                if _angle_deg(pose, located.pose) > SAME_POSE_DEG:
                    pose = located.pose
            locator.add(photo, pose)
            waiting.remove(photo)
            moved = True
    usual = float(np.median([p.sharpness for p in photos]))
    for photo in waiting:
        refused.append(_why(photos[photo], photo in weak, photos[photo].sharpness < BLURRED_SHARE * usual))
    return dict(locator.poses), refused


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


def _angle_deg(a: Pose, b: Pose) -> float:
    cosine = (float(np.trace(a.R.T @ b.R)) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


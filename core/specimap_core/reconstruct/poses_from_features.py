"""Poses of the photos that markers leave open: by resection or structure from motion, with SIFT or ALIKED.

``auto`` begins with SIFT, which is cheap and, where much of it matches, the more accurate. Where ALIKED is installed,
a pose that few of SIFT's matches agree on is not taken: ALIKED comes next, and then SIFT as far as it goes. The report
states it, with the specimen's texture, but only where features were needed at all.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import BackendUnavailableError
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.notices import Notice, Notices
from specimap_core.photos.reading import Photo
from specimap_core.photos.texture import between_markers, in_words, usual_share
from specimap_core.reconstruct.backend import CornersInPhotos, ReconstructSettings
from specimap_core.reconstruct.features.choice import aliked_missing, feature_kind
from specimap_core.reconstruct.resection import Locator
from specimap_core.reconstruct.structure_from_motion import Motion, structure_from_motion

SAME_POSE_DEG = 8.0
SURE_INLIERS = 60
"""Matches that must agree on a pose by SIFT where ALIKED could have a try: with fewer, where glistening tissue was all
that photos shared, poses were off by up to 7 degrees."""
NAMES = {"sift": "SIFT", "aliked": "ALIKED with LightGlue"}
ABSENT = "ALIKED, which may locate more, is not installed."

Share = Callable[[float], None]


@dataclass(frozen=True)
class FeaturePoses:
    """``poses``: all photos posed, by index, in the marker frame, mm; ``warnings``: for the report."""

    poses: dict[int, Pose]
    warnings: Notices


def pose_by_resection(
    photos: list[Photo],
    lens: Intrinsics,
    certain: dict[int, Pose],
    ambiguous: dict[int, tuple[Pose, Pose]],
    waiting: list[int],
    corners: Floats,
    settings: ReconstructSettings,
    *,
    workers: int,
    progress: Share,
) -> FeaturePoses:
    """Resect the ``waiting`` photos against features triangulated from those whose poses are ``certain``;
    ``ambiguous``: the two poses that a single marker leaves.

    Raises:
        BackendUnavailableError: the features asked for do not load.
    """
    # The specimen lies inside the layout, about a fifth of its size above the plane.
    target = corners.reshape(-1, 3).mean(0) + np.array([0, 0, 0.1 * np.ptp(corners[..., 0])])
    poses, open_photos = dict(certain), list(waiting)
    locators: dict[str, Locator] = {}
    seen = [(photos[p], between_markers(lens, pose, corners, photos[p].size)) for p, pose in sorted(certain.items())]
    texture = in_words(usual_share(seen), "the picture between the markers")
    sentences = [f"{len(waiting)} of {len(photos)} photos were not posed by markers alone.", texture]

    def tick() -> None:
        progress(1 - len(open_photos) / len(waiting))

    def attempt(name: str, why: str, least_inliers: int = 0) -> None:
        before = len(open_photos)
        if name not in locators:
            kind = feature_kind(name, workers)
            locators[name] = Locator(photos, lens, poses, target, settings.seed, kind, tick)
        locator = locators[name]
        locator.begin(poses, least_inliers)
        _resect_all(locator, open_photos, ambiguous)
        poses.update(locator.poses)
        found, placed = locator.feature_counts()
        sentences.append(
            f"{NAMES[name]}{why} located {before - len(open_photos)} of {before} (median {np.median(found or [0]):.0f} "
            f"features in a photo, {np.median(placed or [0]):.0f} of them placed in space)."
        )

    if settings.features != "auto":
        attempt(settings.features, ", as asked,")
    elif aliked_missing():
        attempt("sift", ", tried first,")
        if open_photos:
            sentences.append(ABSENT)
    else:
        attempt("sift", f", tried first and taken where {SURE_INLIERS} matches agree,", SURE_INLIERS)
        if open_photos:
            _attempt_optional(lambda: attempt("aliked", ", for the rest,"), sentences)
        if open_photos:
            attempt("sift", ", now with fewer matches,")
    return FeaturePoses(poses, (Notice("features_chosen", " ".join(sentences)),))


def _attempt_optional(attempt: Callable[[], None], sentences: list[str]) -> None:
    """Try features that nobody asked for; where they do not load, the report states it and the run goes on."""
    try:
        attempt()
    except BackendUnavailableError as error:
        sentences.append(error.message)


def _resect_all(locator: Locator, waiting: list[int], ambiguous: dict[int, tuple[Pose, Pose]]) -> None:
    """Locate photos of ``waiting`` and take them off it, until none is left or none gets located.

    First those that a marker places roughly, against their neighbours; then the rest, the easiest first, since each
    that is located helps the next; last in other quarter turns.
    """
    for photo in [p for p in waiting if p in ambiguous]:
        _resect_one(locator, photo, waiting, ambiguous, turned=False)
    tried: dict[tuple[int, bool], int] = {}

    def advance(turned: bool) -> bool:
        for photo in locator.most_similar_first(waiting):
            # Nothing new has been posed since the last attempt.
            if tried.get((photo, turned)) == len(locator.poses):
                continue
            tried[photo, turned] = len(locator.poses)
            if _resect_one(locator, photo, waiting, ambiguous, turned=turned):
                return True
        return False

    while waiting and (advance(turned=False) or advance(turned=True)):
        pass


def _resect_one(
    locator: Locator, photo: int, waiting: list[int], ambiguous: dict[int, tuple[Pose, Pose]], *, turned: bool
) -> bool:
    among = locator.nearest_by_direction(ambiguous[photo]) if photo in ambiguous else None
    located = locator.locate(photo, among, turned=turned)
    if located is None:
        return False
    pose = located.pose
    if photo in ambiguous:
        by_marker = min(ambiguous[photo], key=lambda p: _angle_deg(p, located.pose))
        # The marker's own pose is the finer one, where features say that it is the right one of the two.
        pose = by_marker if _angle_deg(by_marker, located.pose) <= SAME_POSE_DEG else located.pose
    locator.add(photo, pose, located.turn)
    waiting.remove(photo)
    return True


def pose_by_structure_from_motion(
    photos: list[Photo],
    left_out: Collection[int],
    corners: CornersInPhotos,
    focal_px: float | None,
    settings: ReconstructSettings,
    *,
    workers: int,
    progress: Share,
) -> tuple[FeaturePoses, Intrinsics, Floats] | None:
    """Pose photos by features alone, where markers pose too few to start from; markers then give frame and scale.

    Returns poses, lens and corners; None where the photos are not connected, or show no marker twice.
    """
    kept = [p for p in range(len(photos)) if p not in left_out]
    texture = in_words(usual_share((photos[p], None) for p in kept), "the photos")
    sentences = [f"Markers pose too few of {len(photos)} photos: poses come from image features.", texture]
    steps = 0

    def tick() -> None:
        nonlocal steps
        steps += 1
        progress(1 - 0.99**steps)  # how many steps there are shows only at the end

    best: Motion | None = None

    def attempt(name: str) -> None:
        nonlocal best
        found = structure_from_motion(
            [photos[p] for p in kept],
            feature_kind(name, workers),
            focal_px,
            seed=settings.seed,
            workers=workers,
            tick=tick,
        )
        count = len(found.poses) if found else 0
        sentences.append(f"{NAMES[name]} connected {count} of {len(kept)}.")
        if found and (best is None or count > len(best.poses)):
            best = Motion(found.lens, {kept[p]: pose for p, pose in found.poses.items()})

    attempt("aliked" if settings.features == "aliked" else "sift")
    if settings.features == "auto" and (best is None or len(best.poses) < len(kept)):
        if aliked_missing():
            sentences.append(ABSENT)
        else:
            _attempt_optional(lambda: attempt("aliked"), sentences)
    if best is None:
        return None
    placed = best.in_marker_frame(corners.seen, len(corners.marker_ids), settings.edge_mm)
    if placed is None:
        return None
    poses, points = placed
    return FeaturePoses(poses, (Notice("features_chosen", " ".join(sentences)),)), best.lens, points


def _angle_deg(a: Pose, b: Pose) -> float:
    cosine = (float(np.trace(a.R.T @ b.R)) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

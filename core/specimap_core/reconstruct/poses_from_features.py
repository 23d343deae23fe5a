"""Photos that markers leave open: which features locate them, and in which order.

``auto`` begins with SIFT, which is cheap and, where much of it matches, the more accurate. Where ALIKED is installed,
a pose that few of SIFT's matches agree on is not taken: ALIKED comes next, and then SIFT as far as it goes. The report
says so, with the specimen's texture, but only where features were needed at all.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from specimap_core.errors import BackendUnavailableError
from specimap_core.geometry.cameras import Floats, Intrinsics, Pose
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
class Reached:
    """``poses``: all photos posed, by index, in the marker frame, mm; ``warnings``: for the report."""

    poses: dict[int, Pose]
    warnings: Notices


def reach_by_places(
    photos: list[Photo],
    lens: Intrinsics,
    sure: dict[int, Pose],
    either: dict[int, tuple[Pose, Pose]],
    waiting: list[int],
    corners: Floats,
    settings: ReconstructSettings,
    *,
    workers: int,
    progress: Share,
) -> Reached:
    """Locate ``waiting`` photos against those that are ``sure``; ``either``: the two poses that a single marker leaves.

    Raises:
        BackendUnavailableError: the features asked for do not load.
    """
    # The specimen lies inside the layout, about a fifth of its size above the plane.
    target = corners.reshape(-1, 3).mean(0) + np.array([0, 0, 0.1 * np.ptp(corners[..., 0])])
    poses, open_photos = dict(sure), list(waiting)
    seen = [(photos[p], between_markers(lens, pose, corners, photos[p].size)) for p, pose in sorted(sure.items())]
    texture = in_words(usual_share(seen), "the picture between the markers")
    said = [f"{len(waiting)} of {len(photos)} photos were not posed by markers alone.", texture]

    def tick() -> None:
        progress(1 - len(open_photos) / len(waiting))

    def by(name: str, why: str, least_inliers: int = 0) -> None:
        before = len(open_photos)
        kind = feature_kind(name, workers)
        locator = Locator(photos, lens, poses, target, settings.seed, kind, tick, least_inliers=least_inliers)
        _walk(locator, open_photos, either)
        poses.update(locator.poses)
        found, placed = locator.counts()
        said.append(
            f"{NAMES[name]}{why} located {before - len(open_photos)} of {before} (median {np.median(found or [0]):.0f} "
            f"features in a photo, {np.median(placed or [0]):.0f} of them placed in space)."
        )

    if settings.features != "auto":
        by(settings.features, ", as asked,")
    elif aliked_missing():
        by("sift", ", tried first,")
        if open_photos:
            said.append(ABSENT)
    else:
        by("sift", f", tried first and taken where {SURE_INLIERS} matches agree,", SURE_INLIERS)
        if open_photos:
            _unasked(lambda: by("aliked", ", for the rest,"), said)
        if open_photos:
            by("sift", ", now with fewer matches,")
    return Reached(poses, (Notice("features_chosen", " ".join(said)),))


def _unasked(attempt: Callable[[], None], said: list[str]) -> None:
    """Go on with ALIKED, unasked: where it does not load, that is only said."""
    try:
        attempt()
    except BackendUnavailableError as error:
        said.append(error.message)


def _walk(locator: Locator, waiting: list[int], either: dict[int, tuple[Pose, Pose]]) -> None:
    """Locate photos of ``waiting`` and take them off it, until none is left or none gets located.

    First those that a marker places roughly, against their neighbours; then the rest, the easiest first, since each
    that is located helps the next; last in other quarter turns.
    """
    for photo in [p for p in waiting if p in either]:
        _locate(locator, photo, waiting, either, turned=False)
    tried: dict[tuple[int, bool], int] = {}

    def advance(turned: bool) -> bool:
        for photo in locator.easiest_first(waiting):
            # Nothing new has been posed since the last attempt.
            if tried.get((photo, turned)) == len(locator.poses):
                continue
            tried[photo, turned] = len(locator.poses)
            if _locate(locator, photo, waiting, either, turned=turned):
                return True
        return False

    while waiting and (advance(turned=False) or advance(turned=True)):
        pass


def _locate(
    locator: Locator, photo: int, waiting: list[int], either: dict[int, tuple[Pose, Pose]], *, turned: bool
) -> bool:
    among = locator.near(either[photo]) if photo in either else None
    located = locator.locate(photo, among, turned=turned)
    if located is None:
        return False
    pose = located.pose
    if photo in either:
        by_marker = min(either[photo], key=lambda p: _angle_deg(p, located.pose))
        # The marker's own pose is the finer one, where features say that it is the right one of the two.
        pose = by_marker if _angle_deg(by_marker, located.pose) <= SAME_POSE_DEG else located.pose
    locator.add(photo, pose, located.turn)
    waiting.remove(photo)
    return True


def reach_by_motion(
    photos: list[Photo],
    left_out: Collection[int],
    corners: CornersInPhotos,
    focal_px: float | None,
    settings: ReconstructSettings,
    *,
    workers: int,
    progress: Share,
) -> tuple[Reached, Intrinsics, Floats] | None:
    """Pose photos by features alone, where markers pose too few to start from; markers then give frame and scale.

    Returns poses, lens and corners; None where photos do not hang together, or show no marker twice.
    """
    kept = [p for p in range(len(photos)) if p not in left_out]
    texture = in_words(usual_share((photos[p], None) for p in kept), "the photos")
    said = [f"Markers pose too few of {len(photos)} photos: poses come from image features.", texture]
    steps = 0

    def tick() -> None:
        nonlocal steps
        steps += 1
        progress(1 - 0.99**steps)  # how many steps there are shows only at the end

    best: Motion | None = None

    def by(name: str) -> None:
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
        said.append(f"{NAMES[name]} connected {count} of {len(kept)}.")
        if found and (best is None or count > len(best.poses)):
            best = Motion(found.lens, {kept[p]: pose for p, pose in found.poses.items()})

    by("aliked" if settings.features == "aliked" else "sift")
    if settings.features == "auto" and (best is None or len(best.poses) < len(kept)):
        if aliked_missing():
            said.append(ABSENT)
        else:
            _unasked(lambda: by("aliked"), said)
    if best is None:
        return None
    placed = best.in_marker_frame(corners.seen, len(corners.marker_ids), settings.edge_mm)
    if placed is None:
        return None
    poses, points = placed
    return Reached(poses, (Notice("features_chosen", " ".join(said)),)), best.lens, points


def _angle_deg(a: Pose, b: Pose) -> float:
    cosine = (float(np.trace(a.R.T @ b.R)) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

"""From where each photo was taken, as measured by its markers: for a picture of what is photographed already.

No calibration: the focal length is one of the unknowns. With numpy alone, so that the service can do it. The job itself
measures anew, and far better.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import MarkerScene, solve
from specimap_core.fiducials.layout import marker_frame
from specimap_core.fiducials.observations import Observations, corners_of
from specimap_core.geometry.cameras import Intrinsics, Pose, fit_similarity
from specimap_core.screening.planar_layout import (
    Layout,
    focal_of,
    layout_homography,
    mapped,
    placed_corners,
    plane_layout,
    pose_of,
)

LEAST_MARKERS = 2
"""In a photo: a single square has two poses."""
MOST_MARKERS = 8
"""That are looked at, the most seen ones: more make the answer no better."""
JOINT_PHOTOS = 40
"""Photos that are solved together; of more, the others are placed by the layout that these give."""
ITERATIONS = 12
WORKING_PX = 1280
"""Longer side that corners are brought to, so that photos of all resolutions and both orientations share a lens."""
LEAST_AREA_PX = 16.0
"""Of a marker's square at the working size."""
MISFIT_PX = 6.0
"""Above this many pixels of the working size (RMS) a photo's markers lie elsewhere than the others'."""


@dataclass(frozen=True)
class MarkersSeen:
    """What a photo shows: its size (width, height), and corners (4, 2) by marker in its pixels, upright."""

    size: tuple[int, int]
    corners: Mapping[int, Floats]


@dataclass(frozen=True)
class Viewpoint:
    """Where a camera stood, from the markers' centre: azimuth from x toward y, elevation above their plane."""

    azimuth_deg: float
    elevation_deg: float
    distance_mm: float


@dataclass(frozen=True)
class Views:
    """Viewpoints by the photo's number; ``markers``: corners (4, 3) in the marker frame, by id."""

    viewpoints: dict[int, Viewpoint]
    markers: dict[int, Floats]


def measured_views(photos: Sequence[MarkersSeen], edge_mm: float) -> Views:
    """Place all photos that show two markers which others show, too; photos that contradict most are left out."""
    about = [_about_centre(photo) for photo in photos]
    counts = Counter(marker for corners in about for marker in corners)
    # Texture reads as a marker now and then, but not twice as the same one.
    real = {marker for marker, n in counts.most_common(MOST_MARKERS) if n > 1 or len(photos) < 3}
    shown = [{marker: px for marker, px in corners.items() if marker in real} for corners in about]
    usable = [k for k, corners in enumerate(shown) if len(corners) >= LEAST_MARKERS]
    layout = plane_layout([shown[k] for k in _spread(usable, JOINT_PHOTOS)], edge_mm)
    homographies = {k: H for k in usable if (H := _homography(layout, shown[k], edge_mm)) is not None}
    if not homographies:
        return Views({}, {})
    joint = _spread(list(homographies), JOINT_PHOTOS)
    focal = focal_of([homographies[k] for k in joint], WORKING_PX)
    # Pixels about the principal point: the lens's own is where it starts.
    lens = Intrinsics(WORKING_PX, WORKING_PX, focal, (WORKING_PX - 1) / 2, (WORKING_PX - 1) / 2)
    poses = {k: pose_of(homographies[k], focal) for k in joint}
    scene, kept = _solved(shown, poses, layout, lens, edge_mm)
    # Photos beyond the joint solution are placed in the plane.
    others = {k: H for k, H in homographies.items() if k not in joint}
    placed = {k: H for k, H in others.items() if _misfit(H, layout, shown[k], edge_mm) < MISFIT_PX}
    return _in_marker_frame(scene, kept, placed, layout, edge_mm)


def _about_centre(photo: MarkersSeen) -> dict[int, Floats]:
    width, height = photo.size
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    scaled = {marker: (px - centre) * (WORKING_PX / max(width, height)) for marker, px in photo.corners.items()}
    return {marker: px for marker, px in scaled.items() if _convex(px)}


def _convex(corners: Floats) -> bool:
    """Whether four corners are those of a marker seen from its printed side, and not too small."""
    along = np.roll(corners, -1, 0) - corners
    after = np.roll(along, -1, 0)
    return bool((along[:, 0] * after[:, 1] - along[:, 1] * after[:, 0] > LEAST_AREA_PX).all())


def _homography(layout: Layout, corners: Mapping[int, Floats], edge_mm: float) -> Floats | None:
    if len(corners.keys() & layout.keys()) < LEAST_MARKERS:
        return None
    return layout_homography(layout, corners, edge_mm)


def _spread(numbers: list[int], most: int) -> list[int]:
    """At most so many of them, evenly, the last one among them."""
    if len(numbers) <= most:
        return numbers
    return [numbers[i] for i in np.linspace(0, len(numbers) - 1, most).round().astype(int)]


def _observations(
    shown: Sequence[Mapping[int, Floats]], photos: Sequence[int], markers: Sequence[int], lens: Intrinsics
) -> Observations:
    rows = [(p, m, k, marker) for p, k in enumerate(photos) for m, marker in enumerate(markers) if marker in shown[k]]
    corners = np.array([shown[k][marker] for _, _, k, marker in rows]) + np.array([lens.cx, lens.cy])
    photo, marker = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    return Observations(photo, marker, corners, np.full(len(rows), 0.3))


def _solved(
    shown: Sequence[Mapping[int, Floats]], poses: Mapping[int, Pose], layout: Layout, lens: Intrinsics, edge_mm: float
) -> tuple[MarkerScene, list[int]]:
    """Solve lens, poses and markers together; once more without photos that contradict the rest."""
    photos, markers = sorted(poses), sorted(layout)
    squares = tuple(_square(layout[marker]) for marker in markers)
    scene = MarkerScene(lens, tuple(poses[k] for k in photos), corners_of(squares, edge_mm), squares)
    for _ in range(2):
        seen = _observations(shown, photos, markers, lens)
        scene, _ = solve(scene, seen, edge_mm=edge_mm, refine_lens=True, iterations=ITERATIONS)
        miss = np.sqrt((scene.residuals(seen) ** 2).sum(-1).mean(1))
        fits = [bool(np.median(miss[seen.photo == p]) < MISFIT_PX) for p in range(len(photos))]
        if all(fits) or not any(fits):
            break
        photos = [k for k, good in zip(photos, fits, strict=True) if good]
        scene = replace(scene, poses=tuple(pose for pose, good in zip(scene.poses, fits, strict=True) if good))
    return scene, photos


def _square(place: Floats) -> Pose:
    c, s = np.cos(place[2]), np.sin(place[2])
    return Pose(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([place[0], place[1], 0.0]))


def _in_marker_frame(
    scene: MarkerScene,
    kept: Sequence[int],
    placed: Mapping[int, Floats],
    layout: Layout,
    edge_mm: float,
) -> Views:
    """``kept``: photos of the scene. ``placed``: further ones, by their homography of the plane, which is laid onto the
    solved markers."""
    markers = sorted(layout)
    plane = corners_of(tuple(_square(layout[m]) for m in markers), edge_mm).reshape(-1, 3)
    _, R, t = fit_similarity(plane, scene.corners.reshape(-1, 3))
    onto = Pose(R, t)
    centres = {k: pose.centre for k, pose in zip(kept, scene.poses, strict=True)}
    for k, H in placed.items():
        centres[k] = onto.apply(pose_of(H, scene.lens.focal_px).centre)
    frame = marker_frame(scene.corners, np.array(list(centres.values())))
    views = {k: _viewpoint(frame.apply(centre)) for k, centre in sorted(centres.items())}
    return Views(views, {m: frame.apply(corners) for m, corners in zip(markers, scene.corners, strict=True)})


def _misfit(H: Floats, layout: Layout, corners: Mapping[int, Floats], edge_mm: float) -> float:
    known = sorted(corners.keys() & layout.keys())
    miss = [mapped(H, placed_corners(layout[m], edge_mm)) - corners[m] for m in known]
    return float(np.sqrt((np.array(miss) ** 2).sum(-1).mean()))


def _viewpoint(centre: Floats) -> Viewpoint:
    distance = float(np.linalg.norm(centre))
    elevation = np.degrees(np.arcsin(np.clip(centre[2] / max(distance, 1e-9), -1, 1)))
    return Viewpoint(float(np.degrees(np.arctan2(centre[1], centre[0]))), float(elevation), distance)

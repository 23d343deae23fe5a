"""A first guess from marker corners alone: where the markers lie in their plane, how long the lens is, and from where
each photo was taken. With numpy alone: the service estimates this as photos arrive.

Markers lie in one plane to first order, so a photo is a homography of that plane. A single square gives one, which
places the other squares of the same photo; medians over photos make the layout. Homographies of all markers then tell
the focal length (Zhang 2000) and the poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.fiducials.observations import square_corners
from specimap_core.geometry.cameras import Pose

Corners = Mapping[int, Floats]
"""Corners (4, 2) by marker, in pixels about the principal point."""
Layout = dict[int, Floats]
"""By marker: x, y of its centre in mm, and its turn in radians."""

ROUNDS = 6
"""How often layout and homographies are fitted to each other."""
FOCALS = (0.5, 3.0)
"""Focal lengths that lenses have, in longer sides of the photo."""
USUAL_FOCAL = 0.9


def homography(source: Floats, target: Floats) -> Floats:
    """H (3, 3) with ``target ~ H source``, of points (N, 2), N >= 4 (Hartley's normalised direct transform)."""
    normal = [_normalising(points) for points in (source, target)]
    (a, b) = (points @ T[:2, :2].T + T[:2, 2] for points, T in zip((source, target), normal, strict=True))
    zero, one = np.zeros((len(a), 3)), np.column_stack([a, np.ones(len(a))])
    rows = np.concatenate(
        [np.column_stack([one, zero, -b[:, :1] * one]), np.column_stack([zero, one, -b[:, 1:] * one])]
    )
    H = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    H = np.linalg.inv(normal[1]) @ H @ normal[0]
    return np.asarray(H / np.linalg.norm(H))


def _normalising(points: Floats) -> Floats:
    centre = points.mean(0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-12)
    return np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])


def mapped(H: Floats, points: Floats) -> Floats:
    """Points (N, 2) through a homography; infinite ones are not finite."""
    out = np.column_stack([points, np.ones(len(points))]) @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(out[:, :2] / out[:, 2:])


def placed_corners(place: Floats, edge_mm: float) -> Floats:
    """Corners (4, 2) in the plane of a marker at ``place`` (x, y, turn)."""
    c, s = np.cos(place[2]), np.sin(place[2])
    return np.asarray(square_corners(edge_mm)[:, :2] @ np.array([[c, s], [-s, c]]) + place[:2])


def _place_of(corners: Floats, edge_mm: float) -> tuple[Floats, float]:
    """The place of the square nearest to corners (4, 2) in the plane, and its size over the true one."""
    square = square_corners(edge_mm)[:, :2]
    centre = corners.mean(0)
    a = square @ np.array([1, 1j])
    b = (corners - centre) @ np.array([1, 1j])
    turn = (b * a.conj()).sum() / (np.abs(a) ** 2).sum()
    return np.array([centre[0], centre[1], np.angle(turn)]), float(abs(turn))


def plane_layout(photos: Sequence[Corners], edge_mm: float) -> Layout:
    """Where the markers lie in their plane, seen from the side of their print; those that no chain of photos connects
    with the most seen one are left out. ``photos`` show two markers or more each."""
    pairs: dict[tuple[int, int], list[Floats]] = {}
    square = square_corners(edge_mm)[:, :2]
    for corners in photos:
        for a, own in corners.items():
            back = homography(own, square)
            for b, other in corners.items():
                if a == b:
                    continue
                place, size = _place_of(mapped(back, other), edge_mm)
                if np.isfinite(place).all() and 0.3 < size < 3:
                    pairs.setdefault((a, b), []).append(place)
    if not pairs:
        return {}
    seen = {marker: sum(marker in corners for corners in photos) for corners in photos for marker in corners}
    layout: Layout = {max(seen, key=lambda marker: (seen[marker], -marker)): np.zeros(3)}
    while True:
        steps = [(len(found), -b, a) for (a, b), found in pairs.items() if a in layout and b not in layout]
        if not steps:
            break
        _, b, a = max(steps)
        layout[-b] = _beyond(layout[a], _middle(pairs[a, -b]))
    for _ in range(ROUNDS):
        layout = _refitted(layout, photos, edge_mm)
    return layout


def _middle(places: Sequence[Floats]) -> Floats:
    """The median of places, turns as directions."""
    all_ = np.array(places)
    turn = np.angle(np.median(np.cos(all_[:, 2])) + 1j * np.median(np.sin(all_[:, 2])))
    return np.array([*np.median(all_[:, :2], axis=0), turn])


def _beyond(place: Floats, step: Floats) -> Floats:
    c, s = np.cos(place[2]), np.sin(place[2])
    x, y = step[:2]
    return np.array([place[0] + c * x - s * y, place[1] + s * x + c * y, place[2] + step[2]])


def _refitted(layout: Layout, photos: Sequence[Corners], edge_mm: float) -> Layout:
    """The layout that the photos' homographies of the present one show."""
    places: dict[int, list[Floats]] = {}
    for corners in photos:
        H = layout_homography(layout, corners, edge_mm)
        if H is None:
            continue
        back = np.asarray(np.linalg.inv(H), float)
        for marker in corners.keys() & layout.keys():
            place, size = _place_of(mapped(back, corners[marker]), edge_mm)
            if np.isfinite(place).all() and 0.3 < size < 3:
                places.setdefault(marker, []).append(place)
    return {marker: _middle(places[marker]) if marker in places else place for marker, place in layout.items()}


def layout_homography(layout: Layout, corners: Corners, edge_mm: float) -> Floats | None:
    """The homography from the plane to a photo, of all its markers that are placed; None where there is none."""
    known = sorted(corners.keys() & layout.keys())
    if not known:
        return None
    H = homography(
        np.concatenate([placed_corners(layout[marker], edge_mm) for marker in known]),
        np.concatenate([corners[marker] for marker in known]),
    )
    return H if np.isfinite(H).all() and abs(np.linalg.det(H)) > 1e-15 else None


def focal_of(homographies: Sequence[Floats], longer_px: float) -> float:
    """The focal length in pixels that makes the homographies' columns orthogonal and alike; the usual one where all
    photos look straight down, which tells nothing."""
    a, b = [], []
    for H in homographies:
        h, k = (H[:, 0] / np.linalg.norm(H[:, :2]), H[:, 1] / np.linalg.norm(H[:, :2]))
        a += [h[0] * k[0] + h[1] * k[1], (h[0] ** 2 + h[1] ** 2) - (k[0] ** 2 + k[1] ** 2)]
        b += [-h[2] * k[2], -(h[2] ** 2) + k[2] ** 2]
    left, right = np.array(a), np.array(b)
    inverse = float(left @ right / max(float(left @ left), 1e-300))
    low, high = FOCALS
    if inverse <= 0:
        return USUAL_FOCAL * longer_px
    return float(np.clip(1 / np.sqrt(inverse), low * longer_px, high * longer_px))


def pose_of(H: Floats, focal_px: float) -> Pose:
    """The pose ``cam_from_plane`` of a homography, the plane in front of the camera."""
    M = np.diag([1 / focal_px, 1 / focal_px, 1.0]) @ H
    M = M / np.sqrt(np.linalg.norm(M[:, 0]) * np.linalg.norm(M[:, 1]))
    if M[2, 2] < 0:
        M = -M
    u, _, vt = np.linalg.svd(np.column_stack([M[:, 0], M[:, 1], np.cross(M[:, 0], M[:, 1])]))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return Pose(R, M[:, 2])

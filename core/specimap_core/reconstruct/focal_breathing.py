"""Estimate and correct focal breathing: a phone that refocuses changes its focal length by up to a per cent.

Each photo's zoom against the shared lens is estimated with its pose from the markers it shows; photos and corners are
then brought to the shared lens, so that nothing after this knows of it. Seen obliquely, the layout's perspective tells
the focal length from the distance; seen from above it does not, and the prior holds the zoom at one, where
the distance makes it good.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import HUBER, MarkerScene
from specimap_core.errors import SpecimapError
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose, rotation_from_vector, skew
from specimap_core.geometry.robust import MEDIAN_OF_RAYLEIGH
from specimap_core.photos.colour import linear_from_srgb, srgb_from_linear
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.false_markers import misread_ids, start_without_markers, without_markers
from specimap_core.reconstruct.poses_from_markers import MarkerSolution, solve_from_markers

PRIOR_ZOOM = 0.02
"""Standard deviation of the logarithm of a zoom before anything is seen."""
ROUNDS = 8
SIGNIFICANT = 3.0
"""Zooms count where their squares are this many times their own variances on average; without breathing it is 1."""
LEAST_ZOOM = 2e-4
"""Zooms below this move nothing in a photo by a tenth of a pixel."""
LEAST_MARKERS = 2
"""Markers that a photo must show: the perspective of one alone is lost in its corners' noise."""
CORRECTION_ROUNDS = 3
"""Rounds of zooms and poses."""


@dataclass(frozen=True)
class FocalBreathing:
    """``zooms`` (P,): focal length of each photo over the shared one, 1 in the middle; ``sd`` (P,) of their logarithms;
    ``significance``: mean square of the logarithms over their variances, about 1 where nothing breathes."""

    zooms: Floats
    sd: Floats
    significance: float

    @property
    def spread(self) -> float:
        """Standard deviation of the zooms."""
        return float(self.zooms.std())


def correct_focal_breathing(
    photos: list[Photo], corners: CornersInPhotos, *, edge_mm: float, focal_px: float | None, workers: int = 2
) -> tuple[list[Photo], CornersInPhotos, Floats]:
    """Resample photos and corners as one shared lens would have seen them; returns them with the zooms (P,) taken out.

    All zooms are 1, and the rest is as it came, where the photos do not differ beyond what their corners' noise
    explains, or where the markers alone do not solve. Markers that were read where none are leave the corners.
    """
    zooms, seen = np.ones(len(photos)), corners.seen
    solution: MarkerSolution | None = None
    for turn in range(CORRECTION_ROUNDS + 1):
        try:
            solution = solve_from_markers(
                seen, corners.marker_ids, photos[0].size, edge_mm=edge_mm, focal_px=focal_px, start=solution
            )
        except SpecimapError:
            solution = None
            break
        if turn == 0 and 0 < len(wrong := misread_ids(corners, solution)) < len(corners.marker_ids):
            corners = without_markers(corners, wrong)
            seen = corners.seen
            solution = solve_from_markers(
                seen,
                corners.marker_ids,
                photos[0].size,
                edge_mm=edge_mm,
                focal_px=focal_px,
                start=start_without_markers(solution, wrong),
            )
        # The last solution is of the corners as they are handed on.
        found = estimate_focal_breathing(solution.scene, solution.seen) if turn < CORRECTION_ROUNDS else None
        if found is None or (turn == 0 and found.significance < SIGNIFICANT):
            break
        zooms[list(solution.photos)] *= found.zooms
        seen = corners_at_shared_focal(corners.seen, zooms, photos[0].size)
    corners = replace(corners, seen=seen, solution=solution)
    if (zooms == 1).all():
        return photos, corners, zooms
    with ThreadPoolExecutor(workers) as pool:
        images = pool.map(image_at_shared_focal, (p.image for p in photos), zooms.tolist())
        steady = [replace(p, image=image) for p, image in zip(photos, images, strict=True)]
    return steady, corners, zooms


def estimate_focal_breathing(scene: MarkerScene, seen: Observations) -> FocalBreathing | None:
    """Zooms of the photos of a solved scene; None where fewer than three photos determine theirs.

    ``seen`` indexes the scene's photos and markers.
    """
    zooms, sd = np.zeros(len(scene.poses)), np.full(len(scene.poses), PRIOR_ZOOM)
    left: list[Floats] = []
    for photo, pose in enumerate(scene.poses):
        rows = seen.photo == photo
        if int(rows.sum()) < LEAST_MARKERS:
            continue
        corners = scene.corners[seen.marker[rows]].reshape(-1, 3)
        pixels = seen.corners_px[rows].reshape(-1, 2)
        zooms[photo], sd[photo], norm = _zoom_of(scene.lens, pose, corners, pixels, np.repeat(seen.sigma_px[rows], 4))
        left.append(norm)
    known = sd < PRIOR_ZOOM / 2
    if int(known.sum()) < 3:
        return None
    # Scatter of the corners once their photo's zoom is free, over the scatter that their sigma states.
    scatter = float(np.median(np.concatenate(left))) / MEDIAN_OF_RAYLEIGH
    sd[known] *= scatter
    zooms = np.where(known, zooms - np.median(zooms[known]), 0.0)
    significance = float(np.mean((zooms[known] / sd[known]) ** 2))
    # A zoom that is poorly determined is drawn toward one by as much.
    spread = float(np.std(zooms[known]))
    zooms *= spread**2 / (spread**2 + sd**2)
    return FocalBreathing(np.exp(zooms), sd, significance)


def _zoom_of(
    lens: Intrinsics, pose: Pose, corners: Floats, pixels: Floats, sigma: Floats
) -> tuple[float, float, Floats]:
    """Logarithm of one photo's zoom, its standard deviation, marginal over its pose, and the lengths (N,) of what is
    left at the corners, in their standard deviations."""
    zoom = 0.0
    centre = np.array([lens.cx, lens.cy])
    H = np.eye(7)
    for _ in range(ROUNDS):
        cam = pose.apply(corners)
        offset = np.exp(zoom) * (lens.project(cam) - centre)
        residual = offset + centre - pixels
        step = 1e-4
        by_cam = np.stack(
            [
                np.exp(zoom) * (lens.project(cam + step * axis) - lens.project(cam - step * axis)) / (2 * step)
                for axis in np.eye(3)
            ],
            -1,
        )
        J = np.concatenate([-by_cam @ skew(cam - pose.t), by_cam, offset[..., None]], -1)
        norm = np.linalg.norm(residual, axis=1) / sigma
        root = (np.sqrt(np.minimum(1.0, HUBER / np.maximum(norm, 1e-12))) / sigma)[:, None]
        A, r = (J * root[..., None]).reshape(-1, 7), (residual * root).ravel()
        H = A.T @ A
        H[6, 6] += 1 / PRIOR_ZOOM**2
        g = A.T @ r
        g[6] += zoom / PRIOR_ZOOM**2
        change = np.linalg.solve(H, -g)
        pose = Pose(rotation_from_vector(change[:3]) @ pose.R, pose.t + change[3:6])
        zoom += float(np.clip(change[6], -0.02, 0.02))
    left = np.exp(zoom) * (lens.project(pose.apply(corners)) - centre) + centre - pixels
    return zoom, float(np.sqrt(np.linalg.inv(H)[6, 6])), np.asarray(np.linalg.norm(left, axis=1) / sigma)


def corners_at_shared_focal(seen: Observations, zooms: Floats, size: tuple[int, int]) -> Observations:
    """The corners as the shared lens would have seen them; ``zooms`` (P,) by the photos that ``seen`` indexes, about
    the middle of photos of ``size`` (width, height)."""
    middle = (np.array(size) - 1) / 2
    return replace(seen, corners_px=(seen.corners_px - middle) / zooms[seen.photo][:, None, None] + middle)


def image_at_shared_focal(image: NDArray[np.uint8], zoom: float) -> NDArray[np.uint8]:
    """A photo (H, W, 3) as the shared lens would have seen it, same size, its border repeated where it grew."""
    if abs(np.log(zoom)) < LEAST_ZOOM:
        return image
    height, width = image.shape[:2]
    x, y = (1 - zoom) * (width - 1) / 2, (1 - zoom) * (height - 1) / 2
    from_shared = np.array([[zoom, 0, x], [0, zoom, y]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    # In linear light: interpolated as encoded, an edge moves toward its dark side by a tenth of a pixel.
    light = cv2.warpAffine(
        linear_from_srgb(image), from_shared, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    encoded = srgb_from_linear(light)
    encoded *= 255
    encoded += 0.5
    return encoded.astype(np.uint8)

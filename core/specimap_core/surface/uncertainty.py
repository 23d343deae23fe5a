"""One standard deviation of a point's position, so that what is stated holds.

What a point's error depends on was looked for on phantoms: how fast the photos' agreement falls off along the normal
(sharp photos and rich texture make it fall fast), how many photos were compared at the place, how much of its
surroundings they agreed on, how much the surface bends, since patches flatten it, where it breaks off for the cube's
camera, which turns a sideways error into a height, and what markers and specimen leave open of that camera. How much
each counts is set by a rule on some specimens (``bench/sigma.py``), so that 68 % of the errors lie within one and 95 %
within two; docs/accuracy.md has what came of it on others.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.mesh_graph import edges_between
from specimap_core.surface.refinement import Refined

AGREEMENT_MM = 1.5
"""Depths farther from the mesh than this see another surface (an occluder), not this one badly."""
SHARED_ERROR = 0.5
"""Part of a single depth's error that neighbouring pairs share, and that averaging therefore leaves."""
UNSEEN_SIGMA_MM = 1.0
LEAST_SIGMA_MM = 0.01
LEAST_COSINE = 0.15
"""A surface seen more obliquely than this tells little about its height."""

ENOUGH_VIEWS = 9
"""Photos from which on more make a place hardly surer: what is left, they share."""
MOST_UNLIKE = 16.0
"""A vertex counts as at most this much sharper or less sharp than is usual: beyond, its own figure is chance."""
SUPPORT_ROUNDS = 16
"""Steps from vertex to vertex, half of each back: about three edges of the mesh, one standard deviation."""
LEAST_SUPPORT = 0.05
STEP_REACH_MM = 0.17
STEEP_MM = 2 * STEP_REACH_MM * float(np.tan(np.radians(60)))
"""A flank of 60 degrees rises by so much within the reach; what is more is a jump."""


@dataclass(frozen=True)
class Shares:
    """What a standard deviation is made of, as ``python -m bench --only sigma`` sets it.

    ``of_width``, 1/mm: of the squared width of the photos' agreement about its top along the normal. ``of_bend``: of
    the surface's bend over an edge of the mesh (:func:`bend_mm`). ``of_jump``: of a jump of the surface within a cube
    pixel's reach, which a sideways error turns into height.
    """

    of_width: float = 0.5958
    of_bend: float = 2.404
    of_jump: float = 0.4036


SHARES = Shares()


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of a mesh's V vertices: ``scatter`` (V,) mm of the depth maps; which were ``measured`` (V,) by
    comparing photos, and of these n the ``width_mm`` (n,) of the photos' agreement about its top, as if all that can be
    had been compared, ``bend`` (n,) mm (:func:`bend_mm`) and ``support`` (n,) (:func:`support`).
    """

    scatter: NDArray[np.float32]
    measured: NDArray[np.bool_]
    width_mm: Floats
    bend: NDArray[np.float32]
    support: NDArray[np.float32]

    @staticmethod
    def of(refined: Refined, scatter: NDArray[np.float32]) -> Evidence:
        """Of a refined mesh, with the standard deviation (V,) of its depth maps (:func:`vertex_scatter`)."""
        done = (refined.views > 0) & np.isfinite(refined.sharpness)
        topped = refined.sharpness[done & (refined.sharpness > 0)]
        # Where no depth map sees the place, what the photos agree on may be anything.
        measured = done & (scatter < UNSEEN_SIGMA_MM) & (len(topped) > 0)
        usual = float(np.median(topped)) if len(topped) else 1.0
        sharpness = np.clip(refined.sharpness[measured], usual / MOST_UNLIKE, usual * MOST_UNLIKE)
        fewer = np.maximum(ENOUGH_VIEWS / np.maximum(refined.views[measured], 1), 1)
        return Evidence(
            scatter,
            measured,
            np.sqrt(fewer / sharpness),
            bend_mm(refined.mesh)[measured],
            support(refined)[measured],
        )

    def sigma(self, shares: Shares = SHARES) -> NDArray[np.float32]:
        """Standard deviation (V,) mm along the normal."""
        alone = np.hypot(shares.of_width * self.width_mm**2, shares.of_bend * self.bend)
        sigma = self.scatter.copy()
        sigma[self.measured] = alone / np.sqrt(self.support)
        return np.clip(sigma, LEAST_SIGMA_MM, UNSEEN_SIGMA_MM).astype(np.float32)


def mesh_sigma(
    refined: Refined, maps: tuple[DepthMap, ...], poses: tuple[Pose, ...], *, workers: int = 1
) -> NDArray[np.float32]:
    """Standard deviation (V,) mm of a refined mesh's vertices."""
    return Evidence.of(refined, refined_scatter(refined, maps, poses, workers=workers)).sigma()


def refined_scatter(
    refined: Refined, maps: tuple[DepthMap, ...], poses: tuple[Pose, ...], *, workers: int = 1
) -> NDArray[np.float32]:
    """:func:`vertex_scatter` (V,) mm of a refined mesh: new vertices scatter as those do that they lie between."""
    mesh, parents = refined.mesh, refined.parents
    own = parents[:, 0] == parents[:, 1]
    known = int(own.sum())
    before = replace(mesh, vertices=mesh.vertices[:known], normals=mesh.normals[:known])
    scatter = np.zeros(len(own), np.float32)
    scatter[:known] = vertex_scatter(before, maps, poses, workers=workers)
    while known < len(own):
        # Those whose parents are known; their own children come after them.
        ready = known + int(np.searchsorted(parents[known:].max(1) >= known, True))
        ready = ready if ready > known else len(own)
        scatter[known:ready] = scatter[parents[known:ready]].mean(1)
        known = ready
    return scatter


def bend_mm(mesh: Mesh) -> NDArray[np.float32]:
    """How far (V,) mm a mesh bends away over one of its edges: edge length times the angle between the normals at its
    ends, mean over a vertex's edges. Comparing patches flattens a surface in proportion."""
    edges = edges_between(mesh.triangles, len(mesh.vertices)).tocoo()
    a, b = edges.row, edges.col
    length = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1)
    bend = np.linalg.norm(mesh.normals[a] - mesh.normals[b], axis=1) * length
    count = np.maximum(np.bincount(a, minlength=len(mesh.vertices)), 1)
    return np.asarray(np.bincount(a, bend, len(mesh.vertices)) / count, np.float32)


def support(refined: Refined) -> NDArray[np.float32]:
    """Share (V,) of the surroundings, as far as they were refined, on whose places enough photos agreed: the others
    follow their neighbours, and err as these do only near by. At least ``LEAST_SUPPORT``."""
    edges = edges_between(refined.mesh.triangles, len(refined.mesh.vertices))
    degree = np.maximum(np.asarray(edges.sum(1)).ravel(), 1)
    refining = np.isfinite(refined.sharpness)
    shares = np.stack([refined.found & refining, refining], -1).astype(float)
    for _ in range(SUPPORT_ROUNDS):
        shares = (shares + (edges @ shares) / degree[:, None]) / 2
    return np.asarray(np.maximum(shares[:, 0] / np.maximum(shares[:, 1], 1e-9), LEAST_SUPPORT), np.float32)


def vertex_scatter(
    mesh: Mesh, maps: tuple[DepthMap, ...], poses: tuple[Pose, ...], *, workers: int = 1
) -> NDArray[np.float32]:
    """Standard deviation (V,) mm of a mesh fused of depth maps along its normal, from how far they scatter about it."""
    scatter = np.full((max(1, len(maps)), len(mesh.vertices)), np.inf, np.float32)

    def measure(k: int) -> None:
        scatter[k] = _distance_along_normals(mesh, maps[k], poses[maps[k].photo])

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(measure, range(len(maps))))
    count = np.isfinite(scatter).sum(0)
    seen = count > 0
    sigma = np.full(len(mesh.vertices), UNSEEN_SIGMA_MM, np.float32)
    # Sorting puts the unseen (infinite) last, so that the median stands in the middle of the seen.
    ordered = np.sort(scatter[:, seen], axis=0)
    spread = SIGMA_OF_MAD * ordered[count[seen] // 2, np.arange(int(seen.sum()))]
    # Averaging n depths shrinks only the part of their error that is their own.
    share = SHARED_ERROR**2 + (1 - SHARED_ERROR**2) / count[seen]
    sigma[seen] = np.clip(spread * np.sqrt(share), LEAST_SIGMA_MM, UNSEEN_SIGMA_MM)
    return sigma


def _distance_along_normals(mesh: Mesh, depth_map: DepthMap, pose: Pose) -> NDArray[np.float32]:
    """Distance (V,) mm of a depth map from the mesh along the normals; infinite where it does not see it."""
    view = depth_map.view(pose)
    lens = view.intrinsics
    centre = view.cam_from_world.centre.astype(np.float32)
    sight = centre - mesh.vertices
    cam = -sight @ view.cam_from_world.R.T.astype(np.float32)
    z = np.maximum(cam[:, 2], 1e-3)
    height, width = depth_map.depth.shape
    x, y = (cam[:, k] * np.float32(lens.focal_px) / z + np.float32(c) for k, c in ((0, lens.cx), (1, lens.cy)))
    # What lies far outside need not fit a whole number.
    column = np.clip(np.rint(x), -1, width).astype(np.int32)
    row = np.clip(np.rint(y), -1, height).astype(np.int32)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.flatnonzero(inside)
    depth = depth_map.depth[row[at], column[at]]
    cosine = (sight[at] * mesh.normals[at]).sum(1) / np.linalg.norm(sight[at], axis=1)
    off = np.abs(depth - cam[at, 2]) * cosine
    good = (depth > 0) & (cosine > LEAST_COSINE) & (off < AGREEMENT_MM)
    out = np.full(len(mesh.vertices), np.inf, np.float32)
    out[at[good]] = off[good]
    return out


def step_height(pixels: NDArray[np.uint16], z: NDArray[np.float32], pixel_mm: float) -> NDArray[np.float32]:
    """Range (S,) of the heights ``z`` (S,) mm around each of the cube's ``pixels`` (S, 2) row, column.

    Within ``STEP_REACH_MM`` of it, taken from whole pixels in proportion: large on flanks and across edges behind
    which the surface lies lower.
    """
    half = max(1, round(STEP_REACH_MM / pixel_mm))
    share = np.float32(STEP_REACH_MM / (half * pixel_mm))
    reach = np.ones((2 * half + 1, 2 * half + 1), np.uint8)
    shape = tuple(int(n) for n in pixels.max(0) + np.uint16(1))
    far = np.float32(1e6)
    rows, cols = pixels[:, 0], pixels[:, 1]
    grid = np.full(shape, -far, np.float32)
    grid[rows, cols] = z
    high = cv2.dilate(grid, reach)[rows, cols]
    grid[grid == -far] = far
    low = cv2.erode(grid, reach)[rows, cols]
    return np.asarray(share * (high - low), np.float32)


def point_sigma(
    surface_sigma: NDArray[np.float32],
    step_mm: NDArray[np.float32],
    corner_sigma_mm: float,
    registration_mm: float,
    shares: Shares = SHARES,
) -> NDArray[np.float32]:
    """Standard deviation (S,) mm of points: the surface's own, what jumps of the surface (:func:`step_height` beyond a
    flank's) make of a sideways error, the layout's, and the registration's."""
    shared = np.float32(np.hypot(corner_sigma_mm, registration_mm))
    jump = np.float32(shares.of_jump) * np.maximum(step_mm - np.float32(STEEP_MM), 0)
    return np.asarray(np.hypot(np.hypot(surface_sigma, jump), shared), np.float32)

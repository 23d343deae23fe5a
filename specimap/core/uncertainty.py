"""One standard deviation of a point's position: depth agreement among photos, layout, registration, incidence."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from specimap.core.geometry import Floats, Pose
from specimap.core.reconstruct.depth import DepthMap
from specimap.core.surface import Mesh

SIGMA_OF_MAD = 1.4826
AGREEMENT_MM = 1.5
"""Depths farther from the mesh than this see another surface (an occluder), not this one badly."""
SHARED_ERROR = 0.5
"""Part of a single depth's error that neighbouring pairs share, and that averaging therefore leaves."""
UNSEEN_SIGMA_MM = 1.0
LEAST_COSINE = 0.15
"""A surface seen more obliquely than this tells little about its height."""


def vertex_sigma(
    mesh: Mesh, maps: tuple[DepthMap, ...], poses: tuple[Pose, ...], *, workers: int = 1
) -> NDArray[np.float32]:
    """Standard deviation (V,) mm of the mesh along its normal, from how far the depth maps scatter about it."""
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
    sigma[seen] = np.clip(spread * np.sqrt(share), 0.01, UNSEEN_SIGMA_MM)
    return sigma


def _distance_along_normals(mesh: Mesh, depth_map: DepthMap, pose: Pose) -> NDArray[np.float32]:
    """Distance (V,) mm of a depth map from the mesh along the normals; infinite where it does not see it."""
    view = depth_map.view(pose)
    lens = view.intrinsics
    centre = view.cam_from_world.centre.astype(np.float32)
    sight = centre - mesh.vertices
    cam = -sight @ view.cam_from_world.R.T.astype(np.float32)
    z = np.maximum(cam[:, 2], 1e-3)
    column = np.rint(cam[:, 0] * np.float32(lens.focal_px) / z + np.float32(lens.cx)).astype(np.int32)
    row = np.rint(cam[:, 1] * np.float32(lens.focal_px) / z + np.float32(lens.cy)).astype(np.int32)
    height, width = depth_map.depth.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.flatnonzero(inside)
    depth = depth_map.depth[row[at], column[at]]
    cosine = (sight[at] * mesh.normals[at]).sum(1) / np.linalg.norm(sight[at], axis=1)
    off = np.abs(depth - cam[at, 2]) * cosine
    good = (depth > 0) & (cosine > LEAST_COSINE) & (off < AGREEMENT_MM)
    out = np.full(len(mesh.vertices), np.inf, np.float32)
    out[at[good]] = off[good]
    return out


def point_sigma(
    depth_sigma: NDArray[np.float32],
    incidence_deg: NDArray[np.float32],
    corner_sigma_mm: float,
    registration_mm: float,
) -> NDArray[np.float32]:
    """Standard deviation (S,) mm of points: the surface's own, the layout's, and the registration's, whose
    sideways error becomes a longer way along a slanted surface."""
    slant: Floats = 1 / np.maximum(np.cos(np.radians(np.minimum(incidence_deg, 85.0).astype(float))), 0.08)
    total = np.hypot(np.hypot(depth_sigma * np.minimum(slant, 3.0), corner_sigma_mm), registration_mm * slant)
    return np.asarray(total, np.float32)

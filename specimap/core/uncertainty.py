"""One standard deviation of a point's position: depth agreement among photos, layout, registration, incidence."""

from __future__ import annotations

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


def vertex_sigma(mesh: Mesh, maps: tuple[DepthMap, ...], poses: tuple[Pose, ...]) -> NDArray[np.float32]:
    """Standard deviation (V,) mm of the mesh along its normal, from how far the depth maps scatter about it."""
    count = np.zeros(len(mesh.vertices), np.int32)
    rows = max(1, len(maps))
    scatter = np.full((rows, len(mesh.vertices)), np.inf, np.float32)
    for k, depth_map in enumerate(maps):
        view = depth_map.view(poses[depth_map.photo])
        cam = view.cam_from_world.apply(mesh.vertices.astype(float))
        height, width = depth_map.depth.shape
        pixels = np.round(view.intrinsics.project(cam)).astype(np.int64)
        inside = ((pixels >= 0) & (pixels < [width, height])).all(1) & (cam[:, 2] > 0)
        depth = np.zeros(len(cam), np.float32)
        depth[inside] = depth_map.depth[pixels[inside, 1], pixels[inside, 0]]
        sight = view.cam_from_world.centre - mesh.vertices
        cosine = (sight * mesh.normals).sum(1) / np.linalg.norm(sight, axis=1)
        off = (depth - cam[:, 2]) * cosine
        good = (depth > 0) & (cosine > 0.15) & (np.abs(off) < AGREEMENT_MM)
        scatter[k, good] = np.abs(off[good])
        count += good
    seen = count > 0
    sigma = np.full(len(mesh.vertices), UNSEEN_SIGMA_MM, np.float32)
    # Sorting puts the unseen (infinite) last, so that the median stands in the middle of the seen.
    ordered = np.sort(scatter[:, seen], axis=0)
    spread = SIGMA_OF_MAD * ordered[count[seen] // 2, np.arange(int(seen.sum()))]
    # Averaging n depths shrinks only the part of their error that is their own.
    share = SHARED_ERROR**2 + (1 - SHARED_ERROR**2) / count[seen]
    sigma[seen] = np.clip(spread * np.sqrt(share), 0.01, UNSEEN_SIGMA_MM)
    return sigma


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

"""Move a mesh to where the photos agree: each vertex along its normal, by photo-consistency among many views.

Pairwise depth is fused at the resolution of its matching windows and leans inward on bumps. Here, patches lying in
the surface's own tangent plane are compared among up to nine photos at once (mean pairwise normalised
cross-correlation, as in multi-view stereo since Goesele et al. 2007) for a few offsets along the normal; the best
offset, to a fraction of the step, is smoothed over neighbours by how sharply it is determined. Further, shorter
passes start from the normals that those before have put right.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.progress import within
from specimap_core.surface.fusion import Mesh, edges_between, vertex_normals
from specimap_core.surface.photo_consistency import Photographs, choose_views, patch_scores
from specimap_core.surface.settings import Pass, RefineSettings

CHUNK = 2048


@dataclass(frozen=True)
class Refined:
    """A refined mesh, and how it came about.

    ``views`` (V,): photos that were compared at a vertex, 0 where none were. ``sharpness`` (V,), 1/mm^2: how fast
    their mean correlation falls off along the normal, its curvature times its height; 0 where it has no top within
    reach, NaN where the vertex was not refined. ``found`` (V,): whether enough photos agreed on the vertex's place; the
    others follow their neighbours.
    """

    mesh: Mesh
    views: NDArray[np.uint8]
    sharpness: NDArray[np.float32]
    found: NDArray[np.bool_]


def pixel_footprint_mm(lens: Intrinsics, poses: tuple[Pose, ...], target: Floats) -> float:
    """Size of a photo's pixel at ``target`` (3,) mm, median over the photos."""
    return float(np.median([np.linalg.norm(p.centre - target) for p in poses])) / lens.focal_px


def refine_mesh(
    mesh: Mesh,
    images: list[NDArray[np.uint8]],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    voxel_mm: float,
    settings: RefineSettings,
    *,
    workers: int,
    worth: NDArray[np.bool_] | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Refined:
    """The mesh with its vertices moved along their normals; ``images`` (H, W) grey, in the order of ``poses``.

    ``worth`` (V,): the vertices that are worth the time, all by default; the others keep their places.
    """
    chosen = np.arange(len(mesh.vertices)) if worth is None else np.flatnonzero(worth)
    photographs = Photographs([image.astype(np.float32) for image in images], lens, poses)
    cost = [p.steps * p.views for p in settings.passes]
    count = len(mesh.vertices)
    unknown = np.full(count, np.nan, np.float32)
    refined = Refined(mesh, np.zeros(count, np.uint8), unknown, np.zeros(count, bool))
    views: NDArray[np.int64] | None = None
    for k, one in enumerate(settings.passes if len(chosen) else ()):
        done, share = sum(cost[:k]) / sum(cost), cost[k] / sum(cost)
        if views is None or not one.keep_views:
            views = choose_views(refined.mesh, chosen, photographs, one.views, settings.least_cosine, workers=workers)
        progress(done + 0.2 * share)
        refined = _refined_once(
            refined,
            chosen,
            views,
            photographs,
            voxel_mm,
            settings,
            one,
            workers,
            within(progress, done + 0.2 * share, done + share),
        )
    progress(1.0)
    return refined


def _refined_once(
    start: Refined,
    chosen: NDArray[np.int64],
    views: NDArray[np.int64],
    photographs: Photographs,
    voxel_mm: float,
    settings: RefineSettings,
    one: Pass,
    workers: int,
    progress: Callable[[float], None],
) -> Refined:
    """One pass over the ``chosen`` (n,) vertices, by the photos in ``views`` (n, k)."""
    mesh = start.mesh
    points, normals = mesh.vertices[chosen].astype(float), mesh.normals[chosen].astype(float)
    reach = one.reach_voxels * voxel_mm
    offsets = np.linspace(-reach, reach, one.steps)
    sample_mm = pixel_footprint_mm(photographs.lens, photographs.poses, points.mean(0))
    scores = np.zeros((len(points), one.steps), np.float32)

    def run(part: slice) -> None:
        scores[part] = patch_scores(
            points[part], normals[part], views[part], photographs, offsets, sample_mm, one.half_samples
        )

    parts = [slice(k, k + CHUNK) for k in range(0, len(points), CHUNK)]
    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(run, parts), 1):
            progress(0.9 * done / len(parts))
    best, sharp = _best_offsets(scores, offsets)
    sure = ((views >= 0).sum(1) >= 3) & (scores.max(1) > settings.least_score)
    weight = np.where(sure, sharp, 0.0)
    if not (weight > 0).any():
        return start
    weight = np.minimum(weight / np.median(weight[weight > 0]), 5.0)
    offset, trust = np.zeros(len(mesh.vertices)), np.zeros(len(mesh.vertices))
    offset[chosen], trust[chosen] = best, weight
    moved = np.zeros(len(mesh.vertices))
    moved[chosen] = _smoothed(offset, trust, mesh.triangles, settings)[chosen]
    vertices = (mesh.vertices + moved[:, None] * mesh.normals).astype(np.float32)
    compared, sharpness, found = start.views.copy(), start.sharpness.copy(), start.found.copy()
    compared[chosen], found[chosen] = (views >= 0).sum(1), sure
    sharpness[chosen] = sharp / (offsets[1] - offsets[0]) ** 2
    after = Mesh(vertices, mesh.triangles, vertex_normals(vertices, mesh.triangles), mesh.colours)
    return Refined(after, compared, sharpness, found)


def _best_offsets(scores: NDArray[np.float32], offsets: Floats) -> tuple[Floats, Floats]:
    """Offset of the parabola's top (V,) and how sharp it is (V,); 0 sharp where the top is at the end."""
    step = offsets[1] - offsets[0]
    top = scores.argmax(1)
    middle = np.clip(top, 1, len(offsets) - 2)
    rows = np.arange(len(scores))
    left, centre, right = (scores[rows, middle + d].astype(float) for d in (-1, 0, 1))
    bend = left - 2 * centre + right
    curved = bend < -1e-6
    shift = np.clip(np.where(curved, 0.5 * (left - right) / np.where(curved, bend, -1.0), 0.0), -1, 1)
    inner = curved & (top > 0) & (top < len(offsets) - 1)
    return offsets[middle] + shift * step, np.where(inner, -bend * np.maximum(centre, 0), 0.0)


def _smoothed(best: Floats, weight: Floats, triangles: NDArray[np.int32], settings: RefineSettings) -> Floats:
    """Offsets (V,) that follow ``best`` by ``weight`` and their neighbours for the rest (Jacobi rounds)."""
    edges = edges_between(triangles, len(best))
    degree = np.asarray(edges.sum(1)).ravel()
    out = np.where(weight > 0, best, 0.0)
    for _ in range(settings.smoothing_rounds):
        pull = settings.smoothness * (edges @ out)
        out = (weight * best + pull) / (weight + settings.smoothness * degree + 1e-12)
    return np.asarray(out)

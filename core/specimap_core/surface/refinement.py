"""Move a mesh to where the photos agree: each vertex along its normal, by photo-consistency among many views.

Pairwise depth is fused at the resolution of its matching windows and leans inward on bumps. Here, up to sixteen photos
at once are compared at every vertex for a few offsets along the normal, by their local contrast, which gain, shading
and reflections of a room leave alone. Products of contrasts, averaged over the surroundings, make a normalised
cross-correlation whose window follows the surface (as patches do in multi-view stereo since Goesele et al. 2007, which
are flat). The best offset, to a fraction of the step, is smoothed by how sharply it is determined. Later passes reach
less far, on a mesh with edges half as long.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from specimap_core.arrays import Floats, Ints, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.progress import within
from specimap_core.surface.fusion import Mesh, vertex_normals
from specimap_core.surface.mesh_graph import (
    averaged,
    edges_between,
    open_vertices,
    smoothed,
    subdivided,
    unit_averaged,
)
from specimap_core.surface.photo_consistency import (
    CHUNK,
    OWN_VARIANCE,
    Contrasts,
    Photographs,
    agreement,
    choose_views,
)
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.settings import Pass, RefineSettings

LEAST_VIEWS = 3
CHANCE = 1.2
"""Photos that have nothing in common hardly reach a correlation of so many standard deviations of one pixel's, which
for k photos is the root of 2 / (k (k - 1)): a window holds some pixels, but the best of some offsets is taken."""
HEIGHT_POWER = 0.5
"""How sure a place is follows the curvature of the photos' agreement over this power of its height; 1 would be the
width of its top. Gloss lowers the agreement by more than it makes a place unsure. Chosen with the shares of sigma."""
MOST_WEIGHT = 5.0
"""Of a vertex, over the median: beyond, sharpness is chance."""


@dataclass(frozen=True)
class Refined:
    """A refined mesh, and how it came about.

    ``views`` (V,): photos that were compared at a vertex, 0 where none were. ``sharpness`` (V,), 1/mm^2: how fast
    their correlation falls off along the normal, its curvature over a power of its height; 0 where it has no top within
    reach, NaN where the vertex was not refined. ``found`` (V,): whether enough photos agreed on the vertex's place; the
    others follow their neighbours. ``parents`` (V, 2): the vertices of the mesh before that a vertex lies between,
    twice the same where it was one of them.
    """

    mesh: Mesh
    views: NDArray[np.uint8]
    sharpness: NDArray[np.float32]
    found: NDArray[np.bool_]
    parents: Ints


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
    """The mesh with its vertices moved along their normals, and new ones between them; ``images`` (H, W) grey, in the
    order of ``poses``.

    ``worth`` (V,): the vertices that are worth the time, all by default; the others keep their places. The first V
    vertices of the result are those of the mesh.
    """
    count = len(mesh.vertices)
    chosen = np.arange(count) if worth is None else np.flatnonzero(worth)
    itself = np.arange(count)
    unknown = np.full(count, np.nan, np.float32)
    untouched = Refined(mesh, np.zeros(count, np.uint8), unknown, np.zeros(count, bool), np.stack([itself, itself], 1))
    if not len(chosen):
        progress(1.0)
        return untouched
    photographs = Photographs(images, lens, poses)
    pixel_mm = pixel_footprint_mm(lens, poses, mesh.vertices[chosen].mean(0).astype(float))
    refined = replace(untouched, mesh=_calmed(mesh, chosen, settings.start_rounds))
    # Halving the edges makes four vertices of one.
    cost = [
        p.steps * (4 if any(q.finer for q in settings.passes[: k + 1]) else 1) for k, p in enumerate(settings.passes)
    ]
    contrasts: dict[tuple[float, float], Contrasts] = {}
    views: Ints | None = None
    for k, one in enumerate(settings.passes):
        done, share = sum(cost[:k]) / sum(cost), cost[k] / sum(cost)
        if views is None or one.choose_views:
            views = choose_views(
                RayCaster(refined.mesh), chosen, photographs, settings.views, settings.least_cosine, workers=workers
            )
        if one.finer:
            refined, chosen, views = _finer(refined, chosen, views)
        kind = (one.surroundings_voxels, one.blur_voxels)
        if kind not in contrasts:
            voxel_px = voxel_mm / pixel_mm
            contrasts = {kind: Contrasts.of(photographs, kind[0] * voxel_px, kind[1] * voxel_px, workers=workers)}
        progress(done + 0.2 * share)
        refined = _refined_once(
            refined,
            chosen,
            views,
            contrasts[kind],
            one.reach_voxels * voxel_mm,
            one,
            settings,
            workers,
            within(progress, done + 0.2 * share, done + share),
        )
    progress(1.0)
    # What photos do not confirm anywhere stays as it was.
    return refined if refined.found.any() else untouched


def _refined_once(
    start: Refined,
    chosen: Ints,
    views: Ints,
    contrasts: Contrasts,
    reach_mm: float,
    one: Pass,
    settings: RefineSettings,
    workers: int,
    progress: Callable[[float], None],
) -> Refined:
    """One pass over the ``chosen`` (n,) vertices, by the photos in ``views`` (n, k)."""
    mesh = start.mesh
    edges = _edges_among(mesh, chosen)
    points = mesh.vertices[chosen].astype(float)
    directions = unit_averaged(mesh.normals[chosen].astype(float), edges, settings.direction_rounds)
    offsets = np.linspace(-reach_mm, reach_mm, one.steps)
    product, square = (np.empty((len(points), one.steps), np.float32) for _ in range(2))

    def run(part: slice) -> None:
        product[part], square[part] = agreement(points[part], directions[part], views[part], contrasts, offsets)

    parts = [slice(k, k + CHUNK) for k in range(0, len(points), CHUNK)]
    with ThreadPoolExecutor(workers) as pool:
        for done, _ in enumerate(pool.map(run, parts), 1):
            progress(0.8 * done / len(parts))
    both = averaged(np.hstack([product, square]), edges, one.rounds)
    scores = both[:, : one.steps] / (both[:, one.steps :] + np.float32(OWN_VARIANCE))
    best, curvature, height = _tops(scores, offsets)
    compared = (views >= 0).sum(1)
    by_chance = CHANCE * np.sqrt(2 / np.maximum(compared * (compared - 1), 1))
    sure = (compared >= LEAST_VIEWS) & (scores.max(1) > np.maximum(settings.least_score, by_chance))
    weight = np.where(sure, curvature * height, 0.0)
    if not (weight > 0).any():
        return start
    weight = np.minimum(weight / np.median(weight[weight > 0]), MOST_WEIGHT)
    moved = smoothed(best, weight, edges, settings.slope, settings.bend)
    vertices = mesh.vertices.copy()
    vertices[chosen] = points + moved[:, None] * directions
    counts, sharpness, found = start.views.copy(), start.sharpness.copy(), start.found.copy()
    counts[chosen], found[chosen] = compared, sure
    sharpness[chosen] = curvature / np.maximum(height, 0.05) ** HEIGHT_POWER / (offsets[1] - offsets[0]) ** 2
    return replace(start, mesh=_placed(mesh, vertices), views=counts, sharpness=sharpness, found=found)


def _edges_among(mesh: Mesh, chosen: Ints) -> csr_array:
    number = np.full(len(mesh.vertices), -1, np.int32)
    number[chosen] = np.arange(len(chosen), dtype=np.int32)
    triangles = number[mesh.triangles]
    return edges_between(triangles[(triangles >= 0).all(1)], len(chosen))


def _placed(mesh: Mesh, vertices: NDArray[np.float32]) -> Mesh:
    return Mesh(vertices, mesh.triangles, vertex_normals(vertices, mesh.triangles), mesh.colours)


def _calmed(mesh: Mesh, chosen: Ints, rounds: int) -> Mesh:
    """The mesh with its noise smoothed away, but for borders, which would draw back."""
    edges = edges_between(mesh.triangles, len(mesh.vertices))
    degree = np.maximum(np.asarray(edges.sum(1)).ravel(), 1)[:, None]
    still = np.ones(len(mesh.vertices), bool)
    still[chosen] = False
    still |= open_vertices(mesh.triangles, len(mesh.vertices))
    vertices = mesh.vertices.astype(float)
    for _ in range(rounds):
        middle = (edges @ vertices) / degree
        vertices = np.where(still[:, None], vertices, (vertices + middle) / 2)
    return _placed(mesh, vertices.astype(np.float32))


def _finer(refined: Refined, chosen: Ints, views: Ints) -> tuple[Refined, Ints, Ints]:
    """With the edges between ``chosen`` vertices halved; a new vertex is compared in the photos of one beside it."""
    mesh = refined.mesh
    finer = np.zeros(len(mesh.vertices), bool)
    finer[chosen] = True
    triangles, between = subdivided(mesh.triangles, finer)
    a, b = between.T
    vertices = np.concatenate([mesh.vertices, (mesh.vertices[a] + mesh.vertices[b]) / 2])
    colours = np.concatenate([mesh.colours, ((mesh.colours[a].astype(np.uint16) + mesh.colours[b]) // 2)])
    number = np.zeros(len(mesh.vertices), np.int64)
    number[chosen] = np.arange(len(chosen))
    after = Mesh(vertices, triangles, vertex_normals(vertices, triangles), colours.astype(np.uint8))
    with_new = Refined(
        after,
        np.concatenate([refined.views, refined.views[a]]),
        np.concatenate([refined.sharpness, (refined.sharpness[a] + refined.sharpness[b]) / 2]),
        np.concatenate([refined.found, refined.found[a] & refined.found[b]]),
        np.concatenate([refined.parents, between]),
    )
    added = np.arange(len(mesh.vertices), len(vertices))
    return with_new, np.concatenate([chosen, added]), np.concatenate([views, views[number[a]]])


def _tops(scores: Singles, offsets: Floats) -> tuple[Floats, Floats, Floats]:
    """Offset of the parabola's top (V,), its curvature (V,) for a step of one, 0 where the top is at the end, and its
    height (V,)."""
    step = offsets[1] - offsets[0]
    top = scores.argmax(1)
    middle = np.clip(top, 1, len(offsets) - 2)
    rows = np.arange(len(scores))
    left, centre, right = (scores[rows, middle + d].astype(float) for d in (-1, 0, 1))
    bend = left - 2 * centre + right
    curved = bend < -1e-6
    shift = np.clip(np.where(curved, 0.5 * (left - right) / np.where(curved, bend, -1.0), 0.0), -1, 1)
    inner = curved & (top > 0) & (top < len(offsets) - 1)
    return offsets[middle] + shift * step, np.where(inner, -bend, 0.0), np.maximum(centre, 0)

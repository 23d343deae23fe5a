"""Photo-consistency of a surface: the photos compared at each vertex, and how alike its patches are in them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from specimap_core.arrays import Floats, Ints, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.image_sampling import sample
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.raycast import RayCaster

CHUNK = 8192
"""Vertices whose views are chosen at a time."""
NOISE_VARIANCE = 4.0
"""Variance in grey levels that a patch is given on top of its own, so that plain areas do not count as agreeing."""
PATCH_SIGMA = 0.75
"""Standard deviation of a patch's weights as a share of its half width: its middle is where the vertex is."""
IMAGE_MARGIN_PX = 6
SPARE_BEFORE_HIDDEN = 3
"""Candidates beyond those wanted, since some will be hidden."""
SPARE_BEFORE_HIGHLIGHTS = 4
"""Views looked at beyond those wanted, so that highlights can be left out."""
HIGHLIGHT = 1.04
"""A view in which a vertex is brighter than this times its median over the views shows a highlight there."""
LEAST_WITHOUT_HIGHLIGHTS = 4
"""So many of the darkest views are kept, whatever the others show."""
BRIGHTNESS_SIGMA_PX = 1.5


@dataclass(frozen=True)
class Photographs:
    """Grey photos (H, W) float32 of one lens with their ``cam_from_world``, in one order."""

    greys: list[Singles]
    lens: Intrinsics
    poses: tuple[Pose, ...]


def choose_views(
    mesh: Mesh, chosen: Ints, photographs: Photographs, most: int, least_cosine: float, *, workers: int = 1
) -> Ints:
    """For each of the ``chosen`` (n,) vertices the photos that are compared there, (n, most), -1 where there are fewer:
    those that see it most squarely and unhidden, and not in a highlight.

    Highlights move over the surface with the camera and lie where the lamp's mirror image is, below it: photos that
    agree on them agree on a wrong place.
    """
    views = np.empty((len(chosen), most + SPARE_BEFORE_HIGHLIGHTS), np.int64)
    caster = RayCaster(mesh)

    def run(part: slice) -> None:
        views[part] = _most_frontal(caster, chosen[part], photographs, views.shape[1], least_cosine)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(run, [slice(k, k + CHUNK) for k in range(0, len(chosen), CHUNK)]))
    views[_highlights(mesh.vertices[chosen].astype(float), views, photographs)] = -1
    order = np.argsort(views < 0, axis=1, kind="stable")[:, :most]
    return np.take_along_axis(views, order, 1)


def _most_frontal(caster: RayCaster, chosen: Ints, photographs: Photographs, most: int, least_cosine: float) -> Ints:
    """The photos that see each vertex most squarely and unhidden, (n, most); -1 where there are fewer."""
    mesh, lens, poses = caster.mesh, photographs.lens, photographs.poses
    points, normals = mesh.vertices[chosen].astype(float), mesh.normals[chosen].astype(float)
    cosine = np.empty((len(poses), len(points)), np.float32)
    for k, pose in enumerate(poses):
        away = pose.centre - points
        facing = (away * normals).sum(1) / np.linalg.norm(away, axis=1)
        cam = pose.apply(points)
        pixels = lens.project(cam)
        end = np.array([lens.width, lens.height]) - 1 - IMAGE_MARGIN_PX
        inside = (cam[:, 2] > 0) & (pixels > IMAGE_MARGIN_PX).all(1) & (pixels < end).all(1)
        cosine[k] = np.where(inside, facing, -1)
    order = np.argsort(-cosine, axis=0)[: most + SPARE_BEFORE_HIDDEN]
    seen = np.take_along_axis(cosine, order, 0) > least_cosine
    rank, vertex = np.nonzero(seen)
    centres = np.stack([p.centre for p in poses])
    away = centres[order[rank, vertex]] - points[vertex]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    clearance = 0.4 * away + 0.15 * normals[vertex]
    hidden = caster.cast(points[vertex] + clearance, away).hit
    seen[rank[hidden], vertex[hidden]] = False
    place = np.cumsum(seen, axis=0)
    seen &= place <= most
    views = np.full((len(points), most), -1, np.int64)
    rank, vertex = np.nonzero(seen)
    views[vertex, place[rank, vertex] - 1] = order[rank, vertex]
    return views


def _highlights(points: Floats, views: Ints, photographs: Photographs) -> NDArray[np.bool_]:
    """Which ``views`` (n, k) of the points (n, 3) show a highlight there."""
    bright = np.full(views.shape, np.nan, np.float32)
    gain = np.ones(len(photographs.poses), np.float32)
    places = {v: np.nonzero(views == v) for v in np.unique(views[views >= 0]).tolist()}
    for v, (row, column) in places.items():
        soft = cv2.GaussianBlur(photographs.greys[v], (0, 0), BRIGHTNESS_SIGMA_PX)
        at = photographs.lens.project(photographs.poses[v].apply(points[row]))
        bright[row, column] = sample(soft, at[:, 0], at[:, 1])
    usual = _median_of_known(bright)
    for v, (row, column) in places.items():
        # Photos are exposed differently; what most of their surface shows is no highlight.
        gain[v] = np.median(bright[row, column] / np.maximum(usual[row], 1))
    bright /= np.where(views >= 0, np.maximum(gain, 1e-3)[views], 1)
    rank = np.argsort(np.argsort(bright, axis=1), axis=1)
    too_bright = bright > HIGHLIGHT * _median_of_known(bright)[:, None]
    return np.asarray(too_bright & (rank >= LEAST_WITHOUT_HIGHLIGHTS))


def _median_of_known(values: Singles) -> Singles:
    """Median (n,) of the numbers in each row of (n, k); 0 where there is none."""
    ordered = np.sort(values, axis=1)  # what is not a number comes last
    count = np.isfinite(values).sum(1)
    rows = np.arange(len(values))
    middle = (ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, count - 1)]) / 2
    return np.where(count > 0, middle, 0).astype(np.float32)


def patch_scores(
    points: Floats,
    normals: Floats,
    views: Ints,
    photographs: Photographs,
    offsets: Floats,
    sample_mm: float,
    half: int,
) -> Singles:
    """Mean pairwise correlation (m, steps) of what the ``views`` (m, k) show of patches at points (m, 3), moved along
    their normals by the ``offsets`` (steps,) mm.

    A patch lies in the surface's tangent plane, (2 half + 1)^2 samples ``sample_mm`` apart, weighted by a Gaussian.
    """
    lens, poses = photographs.lens, photographs.poses
    # One entry for each photo of each patch, those of one photo together.
    row, column = np.nonzero(views >= 0)
    order = np.argsort(views[row, column], kind="stable")
    row, view = row[order], views[row, column][order]
    count = np.bincount(row, minlength=len(points))
    sum_of_row = csr_array((np.ones(len(row), np.float32), (row, np.arange(len(row)))), shape=(len(points), len(row)))
    first = np.searchsorted(view, np.arange(len(poses) + 1))
    R = np.stack([p.R for p in poses])[view]
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)

    def seen(vectors: Floats) -> Floats:
        return np.asarray(np.einsum("eij,ej->ei", R, vectors[row]))

    # Over a millimetre the projection is linear to a thousandth of a pixel: its derivatives serve all samples.
    cam = seen(points) + np.stack([p.t for p in poses])[view]
    small = 0.05
    base = lens.project(cam)
    by_normal, by_tangent, by_other = (
        (lens.project(cam + small * step) - lens.project(cam - small * step)) / (2 * small)
        for step in map(seen, (normals, tangent, np.cross(normals, tangent)))
    )
    side = np.arange(-half, half + 1, dtype=np.float32)
    across, along = (g.ravel() for g in np.meshgrid(side, side))
    weight = np.exp(-(across**2 + along**2) / (2 * (PATCH_SIGMA * half) ** 2))
    weight /= weight.sum()
    root = np.sqrt(weight)
    patch_x, patch_y = (
        (sample_mm * (np.outer(by_tangent[:, c], across) + np.outer(by_other[:, c], along))).astype(np.float32)
        for c in (0, 1)
    )
    out = np.empty((len(points), len(offsets)), np.float32)
    values = np.empty_like(patch_x)
    for k, offset in enumerate(offsets):
        at = (base + offset * by_normal).astype(np.float32)
        x, y = at[:, :1] + patch_x, at[:, 1:] + patch_y
        for v in range(len(poses)):
            of = slice(first[v], first[v + 1])
            if of.stop > of.start:
                values[of] = sample(photographs.greys[v], x[of], y[of])
        centred = (values - (values @ weight)[:, None]) * root
        square = np.einsum("es,es->e", centred, centred)
        centred /= np.sqrt(square + NOISE_VARIANCE / 4)[:, None]
        together = sum_of_row @ centred
        own = sum_of_row @ (square / (square + NOISE_VARIANCE / 4))
        out[:, k] = (np.einsum("ms,ms->m", together, together) - own) / np.maximum(count * (count - 1), 1)
    return out

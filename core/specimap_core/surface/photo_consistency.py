"""Photo-consistency of a surface: which photos are compared at each vertex, and how well they agree there."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes, Floats, Ints, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.image_sampling import sample
from specimap_core.surface.raycast import RayCaster

CHUNK = 8192
"""Vertices at a time."""
NOISE_VARIANCE = 2.0
"""Variance, in 255ths of the brightest light, that contrast is given on top of its own: plain areas have none."""
OWN_VARIANCE = 0.05
"""The same of the contrast that the photos show at a vertex, of which 1 is usual."""
OBLIQUE = 1.5
"""A photo counts by this power of the cosine at which it sees a vertex."""
IMAGE_MARGIN_PX = 6
SPARE_BEFORE_HIDDEN = 3
"""Candidates beyond those wanted, since some will be hidden."""
CHECKING = slice(7, None, 4)
"""Of the photos that see a place, the most frontal first, those left out of the comparison to check the result with."""
MOST_CHECKING = 4
SPARE_BEFORE_HIGHLIGHTS = 4
"""Views looked at beyond those wanted, so that highlights can be left out."""
HIGHLIGHT = 1.04
"""A view in which a vertex is brighter than this times its median over the views shows a highlight there."""
LEAST_WITHOUT_HIGHLIGHTS = 4
"""So many of the darkest views are kept, whatever the others show."""
BRIGHTNESS_SIGMA_PX = 1.5
LINEAR = 255 * np.where(np.arange(256) <= 10, np.arange(256) / 3294.6, ((np.arange(256) + 14.025) / 269.025) ** 2.4)
"""Light, 0 to 255, of each sRGB value (IEC 61966-2-1)."""


@dataclass(frozen=True)
class Photographs:
    """Grey photos (H, W) uint8 sRGB of one lens with their ``cam_from_world``, in one order."""

    greys: list[Bytes]
    lens: Intrinsics
    poses: tuple[Pose, ...]


@dataclass(frozen=True)
class Contrasts:
    """The local contrast of all photos: what each pixel's light differs from its surroundings, over how much they vary.

    Gain and offset of a photo, shading and what a wet surface mirrors of a room are gone from it, and what is left is
    compared pixel by pixel. ``sheet``: the photos (H, W) float32 side by side, ``columns`` in a row.
    """

    photographs: Photographs
    sheet: Singles
    columns: int

    @staticmethod
    def of(photographs: Photographs, surroundings_px: float, blur_px: float, *, workers: int = 1) -> Contrasts:
        """Of photos blurred by ``blur_px``; the surroundings are a Gaussian of ``surroundings_px``."""
        height, width = photographs.greys[0].shape
        columns = int(np.ceil(np.sqrt(len(photographs.greys))))
        rows = -(-len(photographs.greys) // columns)
        sheet = np.zeros((rows * height, columns * width), np.float32)
        linear = LINEAR.astype(np.float32)

        def put(k: int) -> None:
            light = cv2.LUT(photographs.greys[k], linear)
            if blur_px > 0:
                light = cv2.GaussianBlur(light, (0, 0), blur_px)
            light -= cv2.GaussianBlur(light, (0, 0), surroundings_px)
            light /= np.sqrt(cv2.GaussianBlur(light * light, (0, 0), surroundings_px) + np.float32(NOISE_VARIANCE))
            row, column = divmod(k, columns)
            sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = light

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(put, range(len(photographs.greys))))
        return Contrasts(photographs, sheet, columns)

    def at(self, photo: Ints, pixels: Singles) -> Singles:
        """Contrast (k, n) at ``pixels`` (k, n, 2) of the photos (k, n)."""
        height, width = self.photographs.greys[0].shape
        row, column = np.divmod(photo, self.columns)
        # Beside a photo lies another one.
        x = np.clip(pixels[..., 0], 0, width - 1) + (column * width).astype(np.float32)
        y = np.clip(pixels[..., 1], 0, height - 1) + (row * height).astype(np.float32)
        return sample(self.sheet, x, y)


def choose_views(
    caster: RayCaster, chosen: Ints, photographs: Photographs, most: int, least_cosine: float, *, workers: int = 1
) -> Ints:
    """For each of the ``chosen`` (n,) vertices of the caster's mesh the photos that are compared there, (n, most), -1
    where there are fewer: those that see it most squarely and unhidden, and not in a highlight. Of the more oblique,
    some are left out, so that the result can be checked with photos that did not make it.

    Highlights move over the surface with the camera and lie where the lamp's mirror image is, below it: photos that
    agree on them agree on a wrong place.
    """
    looked_at = most + MOST_CHECKING + SPARE_BEFORE_HIGHLIGHTS
    views = np.empty((len(chosen), looked_at), np.int64)

    def run(part: slice) -> None:
        views[part] = frontal_views(caster, chosen[part], photographs, views.shape[1], least_cosine)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(run, [slice(k, k + CHUNK) for k in range(0, len(chosen), CHUNK)]))
    views[_highlights(caster.mesh.vertices[chosen].astype(float), views, photographs)] = -1
    packed = np.take_along_axis(views, np.argsort(views < 0, axis=1, kind="stable"), 1)
    return np.delete(packed, CHECKING, axis=1)[:, :most]


def frontal_views(caster: RayCaster, chosen: Ints, photographs: Photographs, most: int, least_cosine: float) -> Ints:
    """The photos that see each of the ``chosen`` (n,) vertices most squarely and unhidden, the most frontal first,
    (n, most); -1 where there are fewer."""
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


def agreement(
    points: Floats, directions: Floats, views: Ints, contrasts: Contrasts, offsets: Floats
) -> tuple[Singles, Singles]:
    """What the ``views`` (n, k) show at points (n, 3) moved along unit ``directions`` (n, 3) by the ``offsets``
    (steps,) mm: the mean product of two photos' contrasts, and the mean square of one, both (n, steps).

    Averaged over the surroundings, the first over the second is the correlation between photos. They are weighted by
    how squarely they see a point.
    """
    photographs = contrasts.photographs
    lens, poses = photographs.lens, photographs.poses
    # Photos first: sums over them are then of whole rows.
    photo = np.ascontiguousarray(np.maximum(views, 0).T)
    unused = views.T < 0
    R, t = np.stack([p.R for p in poses]), np.stack([p.t for p in poses])
    x, y, z = ((c - points[:, i]) for i, c in enumerate(np.stack([p.centre for p in poses]).T[:, photo]))
    length = np.sqrt(x * x + y * y + z * z)
    cosine = (x * directions[:, 0] + y * directions[:, 1] + z * directions[:, 2]) / np.maximum(length, 1e-9)
    weight = np.where(unused, 0, np.clip(cosine, 0.02, 1) ** OBLIQUE).astype(np.float32)
    # Over a millimetre the projection is linear to a hundredth of a pixel.
    cam = _turned(R, photo, points) + t[photo]
    # Where no photo is compared, any place before the camera will do.
    cam[unused] = (0.0, 0.0, 1.0)
    base = lens.project(cam)
    small = offsets[-1] / 2
    step = ((lens.project(cam + small * _turned(R, photo, directions)) - base) / small).astype(np.float32)
    base = base.astype(np.float32)
    total, squares = weight.sum(0), (weight * weight).sum(0)
    pairs, singles = np.maximum(total * total - squares, 1e-4), np.maximum(total, 1e-3)
    product, square = (np.empty((len(points), len(offsets)), np.float32) for _ in range(2))
    for k, offset in enumerate(offsets):
        seen = contrasts.at(photo, base + np.float32(offset) * step)
        weighted = seen * weight
        product[:, k] = (weighted.sum(0) ** 2 - (weighted * weighted).sum(0)) / pairs
        square[:, k] = (weighted * seen).sum(0) / singles
    return product, square


def _turned(R: Floats, photo: Ints, vectors: Floats) -> Floats:
    """Vectors (n, 3), turned by the ``R`` (P, 3, 3) of photos (k, n): (k, n, 3)."""
    x, y, z = vectors.T
    return np.stack([R[photo, i, 0] * x + R[photo, i, 1] * y + R[photo, i, 2] * z for i in range(3)], -1)

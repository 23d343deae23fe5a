"""Ray casting a scene into images of any number of channels, with exact first hits.

A pixel is the mean over its area in linear light. One ray serves where a pixel lies within one smooth
material, a few on the specimen, and many where materials meet, so that the markers' edges are unbiased.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import View
from specimap_validation.phantom import materials
from specimap_validation.phantom.scene import BENCH, CARDS, KEY_LIGHTS, SPECIMEN, TRAY, Hits, Scene

CLASS_NONE, CLASS_SPECIMEN, CLASS_CARD, CLASS_TRAY, CLASS_BENCH = range(5)
_CLASS_OF_GEOMETRY = np.array([CLASS_SPECIMEN, CLASS_CARD, CLASS_TRAY, CLASS_BENCH, CLASS_NONE], np.uint8)
# Rays per pixel and step of a Fibonacci lattice, where every ray has a row and a column of its own. Any lattice has
# directions in which its rays lie in few rows, to which an edge that runs along them is rounded (a square grid along
# the pixels, this one at 31 degrees): so each pixel's is shifted by chance, and an edge's pixels err apart.
_SPECIMEN_RAYS, _BORDER_RAYS = 5, 34
_LATTICE_STEP = {_SPECIMEN_RAYS: 3, _BORDER_RAYS: 21}
_SHIFT_SEED = 20
_SHININESS = 60.0
_DETAIL_SD = 0.16
_BENCH_LIGHT = 0.75
# Rays at a time: arrays stay in the processor's cache, and products this small stay off the BLAS threads,
# which would only fight with the threads that render photos in parallel.
_BLOCK = 16384


@dataclass(frozen=True)
class Paint:
    """Response of each channel to each material: ``basis`` (M, C).

    ``vertex`` (V, C + 4): colour, irradiance and normal of the specimen's vertices.
    """

    basis: Singles
    vertex: Singles
    shading: float

    @staticmethod
    def of(scene: Scene, basis: Floats, shading: float = 1.0) -> Paint:
        """Paint for channels (M, C); ``shading`` 0 lights everything evenly, 1 as the scene is lit."""
        s = scene.specimen
        vertex = np.column_stack([s.abundance @ basis, scene.vertex_irradiance, s.normals])
        return Paint(basis.astype(np.float32), vertex.astype(np.float32), shading)


@dataclass(frozen=True)
class Rendering:
    """``image`` (H, W, C) linear; of the ray through each pixel's centre: ``xyz`` (H, W, 3) mm, NaN for none,
    and ``classes`` (H, W) uint8."""

    image: Singles
    xyz: Floats
    classes: NDArray[np.uint8]


def render_view(scene: Scene, view: View, paint: Paint, *, gloss: float = 0.0) -> Rendering:
    """Render the scene as ``view`` sees it; the lens's distortion is applied exactly."""
    h, w = view.intrinsics.height, view.intrinsics.width
    pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    colour, points, surface, geometry = _sample(scene, view, paint, pixels, gloss)

    rays = _rays_per_pixel(surface.reshape(h, w), (geometry == SPECIMEN).reshape(h, w)).ravel()
    shift = np.random.default_rng(_SHIFT_SEED).random((h * w, 1, 2))
    for n, step in _LATTICE_STEP.items():
        chosen = np.flatnonzero(rays == n)
        k = np.arange(n)
        spread = (np.stack([k, k * step % n], 1) / n + shift[chosen]) % 1 - 0.5
        fine = _sample(scene, view, paint, (pixels[chosen, None] + spread).reshape(-1, 2), gloss)[0]
        colour[chosen] = fine.reshape(len(chosen), n, -1).mean(1)
    points[geometry < 0] = np.nan
    return Rendering(colour.reshape(h, w, -1), points.reshape(h, w, 3), _CLASS_OF_GEOMETRY[geometry].reshape(h, w))


def _rays_per_pixel(surface: NDArray[np.int32], on_specimen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(H, W) from the surface and the specimen's mask at the pixels' centres (H, W)."""
    s = surface.astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    border = cv2.dilate(s, square) != cv2.erode(s, square)
    return np.where(border, _BORDER_RAYS, np.where(on_specimen, _SPECIMEN_RAYS, 1)).astype(np.uint8)


def _sample(
    scene: Scene, view: View, paint: Paint, pixels: Floats, gloss: float
) -> tuple[Singles, Floats, NDArray[np.int32], NDArray[np.int32]]:
    """Colour (S, C), point (S, 3), surface (S,) that distinguishes materials, geometry (S,); pixels (S, 2)."""
    colour = np.empty((len(pixels), paint.basis.shape[1]), np.float32)
    points = np.empty((len(pixels), 3))
    surface, geometry = (np.empty(len(pixels), np.int32) for _ in range(2))
    for start in range(0, len(pixels), _BLOCK):
        b = slice(start, start + _BLOCK)
        colour[b], points[b], surface[b], geometry[b] = _sample_block(scene, view, paint, pixels[b], gloss)
    return colour, points, surface, geometry


def _sample_block(
    scene: Scene, view: View, paint: Paint, pixels: Floats, gloss: float
) -> tuple[Singles, Floats, NDArray[np.int32], NDArray[np.int32]]:
    eye = view.origins(pixels)
    directions = view.world_rays(pixels)
    hits = scene.caster.cast(eye, directions)
    points = eye + directions * hits.distance[:, None]
    surface = hits.geometry.copy()
    colour = np.zeros((len(pixels), paint.basis.shape[1]), np.float32)

    on = np.flatnonzero(hits.geometry == SPECIMEN)
    if len(on):
        colour[on] = _specimen_colour(scene, paint, hits, on, points[on], directions[on], gloss)
    on = np.flatnonzero(hits.geometry == TRAY)
    speckle, light = scene.tray_at(points[on])
    plain = paint.basis[materials.TRAY]
    colour[on] = plain + speckle[:, None] * (paint.basis[materials.TRAY_SPECKLE] - plain)
    colour[on] *= _lit(light, paint)[:, None]
    on = np.flatnonzero(hits.geometry == CARDS)
    card = hits.triangle[on] // 2
    white = scene.cards.is_white(card, points[on])
    surface[on] = BENCH + 1 + 2 * card + white
    colour[on] = paint.basis[np.where(white, materials.WHITE_CARD, materials.BLACK_INK)]
    colour[on] *= _lit(scene.tray_at(points[on])[1], paint)[:, None]
    colour[hits.geometry == BENCH] = paint.basis[materials.BENCH] * _BENCH_LIGHT
    return colour, points, surface, hits.geometry


def _specimen_colour(
    scene: Scene,
    paint: Paint,
    hits: Hits,
    on: NDArray[np.intp],
    points: Floats,
    directions: Floats,
    gloss: float,
) -> Singles:
    corner = scene.specimen.triangles[hits.triangle[on]]
    u, v = hits.uv[on, :1], hits.uv[on, 1:]
    at = (1 - u - v) * paint.vertex[corner[:, 0]] + u * paint.vertex[corner[:, 1]] + v * paint.vertex[corner[:, 2]]
    c = paint.basis.shape[1]
    detail = scene.detail_at(points)
    brightness = np.clip(1 + scene.texture_contrast * _DETAIL_SD * detail, 0.3, 1.7)
    colour = at[:, :c] * (brightness * _lit(at[:, c], paint))[:, None]
    if gloss:
        normal = at[:, c + 1 :] / np.linalg.norm(at[:, c + 1 :], axis=1, keepdims=True)
        shine = np.zeros(len(on), np.float32)
        for lamp in KEY_LIGHTS / np.linalg.norm(KEY_LIGHTS, axis=1, keepdims=True):
            half = (lamp - directions).astype(np.float32)
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            shine += np.maximum((half * normal).sum(1), 0) ** _SHININESS
        # A moist surface shines in patches; shaded hollows do not shine.
        patches = np.clip(0.6 + 0.5 * detail, 0, 1.5)
        colour += (2 * gloss * shine * patches * np.minimum(at[:, c], 1))[:, None]
    return np.asarray(colour, np.float32)


def _lit(irradiance: Singles, paint: Paint) -> Singles:
    return np.asarray(1 + paint.shading * (irradiance - 1), np.float32)

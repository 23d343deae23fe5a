"""A camera's picture of the lit scene: rays through the true lens, and what the wet coat mirrors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import View
from specimap_validation.path_traced.optics import Optics
from specimap_validation.path_traced.surfaces import LitScene, Met, Painter

_FRESNEL = 0.035  # reflection of a film of water and protein, looked at from straight above
_SURROUNDINGS = 0.3  # radiance of what a coat mirrors and that is no lamp: about that of the tray
_OFF_MM = 2e-3
_STEP_PX = 0.25  # within a pixel, whose rays share a line of a push-broom


@dataclass(frozen=True)
class Coat:
    """A wet, or glossy, film: shares of the reflection on specimen and cards, and its GGX roughness."""

    specimen: float
    cards: float
    roughness: float


def take_picture(
    lit: LitScene, view: View, painter: Painter, optics: Optics, coat: Coat, *, samples: int, seed: int
) -> tuple[Singles, Singles]:
    """Mean channels (H, W, C) of each pixel, and the light (H, W, 3) that the coat mirrors.

    A pixel is the mean over its area and over the exposure. Where nothing is met, three channels show the room, and
    other numbers of channels nothing.
    """
    h, w = view.intrinsics.height, view.intrinsics.width
    rays = _Rays(view, optics)
    index = dr.arange(mi.UInt32, h * w)
    shift = mi.UInt32(index + dr.opaque(mi.UInt32, seed * 1_000_003 % 2**31))
    row = mi.Float(index // w) / h - 0.5
    channels = [dr.zeros(mi.Float, h * w) for _ in range(painter.channels)]
    mirrored = dr.zeros(mi.Color3f, h * w)
    film = [_number(v) for v in (coat.specimen, coat.cards, coat.roughness, lit.light.radiance_scale)]
    dr.eval(shift, row, channels, mirrored)
    for k in range(samples):
        chance = _Chance(shift, _number(k))
        ray = rays(chance, row)
        hit = lit.scene.ray_intersect_preliminary(ray, coherent=True)
        met = painter(hit, ray)
        values, shine = _coated(lit, met, hit, ray, film, chance)
        mirrored += shine
        if painter.channels == 3:
            place = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit.is_valid())
            room = lit.scene.environment().eval(place, ~hit.is_valid()) * film[3]
            values = [dr.select(hit.is_valid(), value, room[c]) for c, value in enumerate(values)]
        for c, value in enumerate(values):
            channels[c] += value
        dr.eval(channels, mirrored)
    picture = np.stack([np.array(c) for c in channels], 1).reshape(h, w, painter.channels)
    shine_found = np.array(mirrored).reshape(3, h * w).T.reshape(h, w, 3)
    return np.asarray(picture / samples, np.float32), np.asarray(shine_found / samples, np.float32)


def _coated(lit: LitScene, met: Met, hit: Any, ray: Any, film: list[Any], chance: _Chance) -> tuple[list[Any], Any]:
    """What leaves the surfaces under their coat, and what the coat mirrors, by one ray into the GGX lobe."""
    on_specimen, on_cards, roughness, scale = film
    share = dr.select(met.on_specimen, on_specimen, dr.select(met.on_card, on_cards, 0))
    shiny = share > 0
    # Smooth normals can face away at an outline, where the triangle does not.
    facing = dr.dot(met.normal, ray.d)
    normal = dr.select(facing > -0.02, dr.normalize(met.normal - ray.d * (facing + 0.05)), met.normal)
    frame = mi.Frame3f(normal)
    incoming = frame.to_local(-ray.d)
    lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, roughness)
    facet, _ = lobe.sample(incoming, mi.Point2f(chance(7), chance(8)))
    outgoing = 2 * dr.dot(incoming, facet) * facet - incoming
    weight = share * _fresnel(dr.dot(incoming, facet)) * lobe.smith_g1(outgoing, facet)
    away = mi.Ray3f(ray(hit.t) + _OFF_MM * normal, frame.to_world(outgoing))
    seen = lit.scene.ray_intersect(away, active=shiny)
    radiance = seen.emitter(lit.scene, shiny).eval(seen, shiny) * scale
    radiance = dr.select(seen.is_valid() & ~seen.shape.is_emitter(), mi.Color3f(_SURROUNDINGS), radiance)
    shine = dr.select(shiny & (outgoing.z > 0), weight * radiance, 0)
    # What is mirrored does not come through.
    through = 1 - dr.minimum(share, 1) * _fresnel(incoming.z)
    return [value * through for value in met.channels], shine


def _fresnel(cosine: Any) -> Any:
    """Reflection by Schlick's approximation."""
    return _FRESNEL + (1 - _FRESNEL) * dr.power(dr.maximum(1 - cosine, 0), 5)


class _Chance:
    """Numbers 0..1 of a pixel's sample: an additive recurrence (Roberts 2018), shifted by chance for each pixel."""

    _DIMENSIONS = 9

    def __init__(self, shift: Any, sample: Any) -> None:
        self._shift, self._sample = shift, sample

    def __call__(self, dimension: int) -> Any:
        # The root of x^(d + 1) = x + 1, whose powers leave no gaps in d dimensions.
        root = 1.0
        for _ in range(60):
            root = (1 + root) ** (1 / (self._DIMENSIONS + 1))
        value = mi.sample_tea_float32(self._shift, mi.UInt32(dimension)) + self._sample * (root ** -(dimension + 1) % 1)
        return value - dr.floor(value)


class _Rays:
    """Rays of a view's pixels.

    Those of the pixels' middles, and how they change across a pixel, are the view's own, in double precision: within
    a few pixels the change is even to a thousandth of a pixel.
    """

    def __init__(self, view: View, optics: Optics) -> None:
        h, w = view.intrinsics.height, view.intrinsics.width
        pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)

        def at(*offset: float) -> Floats:
            moved = pixels + offset
            return np.concatenate([np.broadcast_to(view.origins(moved), (h * w, 3)), view.world_rays(moved)], 1)

        across, down = ((at(*(_STEP_PX * axis)) - at(*(-_STEP_PX * axis))) / (2 * _STEP_PX) for axis in np.eye(2))
        self._parts = [_vector(part[:, cut]) for part in (at(0, 0), across, down) for cut in (slice(3), slice(3, 6))]
        self._right, self._below, self._axis = (_constant(axis) for axis in view.cam_from_world.R)
        self._turn, self._rolling = _constant(optics.turn), _constant(optics.rolling)
        self._blur, self._aperture, self._focus = map(_number, (optics.blur_px, optics.aperture_mm, optics.focus_mm))
        dr.eval(self._parts)

    def __call__(self, chance: _Chance, row: Any) -> Any:
        """Rays of one sample of every pixel; ``row``: -0.5 in the first row, 0.5 in the last."""
        origin, direction, origin_x, direction_x, origin_y, direction_y = self._parts
        spread = mi.warp.square_to_std_normal(mi.Point2f(chance(2), chance(3)))
        x, y = chance(0) - 0.5 + self._blur * spread.x, chance(1) - 0.5 + self._blur * spread.y
        start = origin + x * origin_x + y * origin_y
        toward = direction + x * direction_x + y * direction_y
        toward += dr.cross(self._turn * (chance(4) - 0.5) + self._rolling * row, toward)
        in_focus = start + toward * (self._focus / dr.dot(toward, self._axis))
        opening = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(chance(5), chance(6)))
        start += self._aperture * (opening.x * self._right + opening.y * self._below)
        return mi.Ray3f(start, dr.normalize(in_focus - start))


def _number(value: float) -> Any:
    """A number that is no constant of the compiled kernel, so that another needs no other kernel."""
    return dr.opaque(mi.Float, float(value))


def _constant(vector: Floats) -> Any:
    return mi.Vector3f(*(_number(v) for v in vector))


def _vector(values: Floats) -> Any:
    return mi.Vector3f(*np.ascontiguousarray(values.T, np.float32))

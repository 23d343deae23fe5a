"""What a ray meets: the surfaces of the scene, and how strongly each channel leaves them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_validation.path_traced.cards import MARGIN, CardMeshes
from specimap_validation.path_traced.lighting import Light, as_mesh, lamps_and_room, tray_and_bench, tray_half_mm
from specimap_validation.path_traced.settings import TracedSettings
from specimap_validation.phantom import materials
from specimap_validation.phantom.noise import band_noise
from specimap_validation.phantom.settings import Stream
from specimap_validation.phantom.specimen import Specimen

_BENCH_LIGHT = 0.7
_GREY = np.full(3, 0.5)
_TRAY_TEXELS = 1024
_COVER_SIZE, _COVER_MM = 1.8, 1.2  # sides over a marker's, height


@dataclass(frozen=True)
class LitScene:
    """The scene for Mitsuba, with the light on it. ``meshes``: vertices and triangles by the surface's name."""

    specimen: Specimen
    cards: CardMeshes
    light: Light
    meshes: dict[str, tuple[Floats, NDArray[np.int32]]]
    scene: Any
    pointers: dict[str, Any]
    speckle: Any


def lit_scene(
    settings: TracedSettings, specimen: Specimen, cards: CardMeshes, light: Light, covered: tuple[int, ...] = ()
) -> LitScene:
    """Put specimen, cards, tray and bench together, and a cover over each marker of ``covered``."""
    meshes = {
        "specimen": (specimen.vertices, specimen.triangles),
        "cards": (cards.vertices, cards.triangles),
        **tray_and_bench(settings),
    }
    for marker in covered:
        corners = cards.corners[settings.marker_ids.index(marker)]
        middle = corners.mean(0)
        cover = middle + _COVER_SIZE * (corners - middle) + [0, 0, _COVER_MM]
        meshes[f"cover_{marker}"] = cover, np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    # Only their shapes count here: what they look like is painted.
    shapes = {name: as_mesh(name, *mesh, _GREY) for name, mesh in meshes.items()}
    texel = 2 * tray_half_mm(settings) / _TRAY_TEXELS
    grain = band_noise(settings.rng(Stream.TRAY), (_TRAY_TEXELS,) * 2, 0.55 / texel, 5.0 / texel, 0.7)
    speckle = np.clip(0.4 + 0.3 * settings.tray_contrast * grain, 0, 1)[..., None]
    return LitScene(
        specimen,
        cards,
        light,
        meshes,
        mi.load_dict({"type": "scene", **shapes, **lamps_and_room()}),
        {name: mi.ShapePtr(shape) for name, shape in shapes.items()},
        mi.Texture2f(mi.TensorXf(np.ascontiguousarray(speckle, np.float32))),
    )


@dataclass(frozen=True)
class Met:
    """What rays meet: ``channels``, C numbers for each ray; its normal; whether it is specimen, or card."""

    channels: list[Any]
    normal: Any
    on_specimen: Any
    on_card: Any


class Painter:
    """Channels of the surfaces of ``lit``.

    ``basis`` (M, C): response of each channel to each material. ``colour`` (C,): which of the light's red, green and
    blue a channel sees. ``vertices`` (V, C): what leaves the specimen's vertices, light included.
    """

    def __init__(self, lit: LitScene, basis: Floats, colour: tuple[int, ...], vertices: Floats) -> None:
        self._lit = lit
        self._basis = basis
        self._colour = colour
        self._stride = basis.shape[1] + 3
        self._vertices = _numbers(mi.Float, np.concatenate([vertices, lit.specimen.normals], 1))
        self._triangles = _numbers(mi.UInt32, lit.specimen.triangles)
        self._card_triangles = _numbers(mi.UInt32, lit.cards.triangles)
        self._card_uv = _numbers(mi.Float, lit.cards.uv)
        self._cells = _numbers(mi.UInt32, lit.cards.white)
        self._tray_light = mi.Texture2f(mi.TensorXf(np.ascontiguousarray(lit.light.tray, np.float32)))
        dr.eval(self._vertices)

    @property
    def channels(self) -> int:
        """C."""
        return len(self._colour)

    def __call__(self, hit: Any, ray: Any) -> Met:
        """Paint what rays meet (``hit``: Mitsuba's preliminary intersection of ``ray``)."""
        met = hit.is_valid()
        on = {name: met & (hit.shape == pointer) for name, pointer in self._lit.pointers.items()}
        specimen, card, tray = on["specimen"], on["cards"], on["tray"]
        covers = [mask for name, mask in on.items() if name.startswith("cover")]
        level = tray | card
        for mask in covers:
            level |= mask
        place = ray(hit.t)
        half = self._lit.light.half_mm
        at = mi.Point2f((place.x / half + 1) / 2, (place.y / half + 1) / 2)
        light = self._tray_light.eval(at, level)
        speckle = self._lit.speckle.eval(at, tray)[0]
        white = self._white(hit, card)
        corners = self._corners(self._triangles, hit, specimen)
        channels = []
        for c in range(self.channels):
            plain, speckled, paper, ink, bench = (
                float(self._basis[m, c])
                for m in (
                    materials.TRAY,
                    materials.TRAY_SPECKLE,
                    materials.WHITE_CARD,
                    materials.BLACK_INK,
                    materials.BENCH,
                )
            )
            flat = dr.select(tray, plain + speckle * (speckled - plain), dr.select(white, paper, ink))
            flat = dr.select(tray | card, flat, bench) * dr.select(level, light[self._colour[c]], _BENCH_LIGHT)
            there = self._between(self._vertices, self._stride, c, corners, hit, specimen)
            channels.append(dr.select(specimen, there, dr.select(met, flat, 0)))
        normal = mi.Normal3f(
            *(self._between(self._vertices, self._stride, self.channels + k, corners, hit, specimen) for k in range(3))
        )
        return Met(channels, dr.select(specimen, dr.normalize(normal), mi.Normal3f(0, 0, 1)), specimen, card)

    def _white(self, hit: Any, card: Any) -> Any:
        """Whether rays that meet cards meet paper."""
        corners = self._corners(self._card_triangles, hit, card)
        n = self._lit.cards.white.shape[1]
        col, row = (
            mi.Int32(dr.floor((self._between(self._card_uv, 2, k, corners, hit, card) - MARGIN) / (1 - 2 * MARGIN) * n))
            for k in range(2)
        )
        inside = card & (col >= 0) & (col < n) & (row >= 0) & (row < n)
        first = hit.prim_index // self._lit.cards.triangles_per_card * (n * n)
        return ~inside | (dr.gather(mi.UInt32, self._cells, first + mi.UInt32(row * n + col), inside) == 1)

    @staticmethod
    def _corners(triangles: Any, hit: Any, active: Any) -> list[Any]:
        return [dr.gather(mi.UInt32, triangles, hit.prim_index * 3 + k, active) for k in range(3)]

    @staticmethod
    def _between(values: Any, stride: int, column: int, corners: list[Any], hit: Any, active: Any) -> Any:
        """A column of ``values``, ``stride`` to a vertex, at hits within the triangles of ``corners``."""
        a, b, c = (dr.gather(mi.Float, values, corner * stride + column, active) for corner in corners)
        u, v = hit.prim_uv.x, hit.prim_uv.y
        return (1 - u - v) * a + u * b + v * c


def _numbers(kind: Any, values: NDArray[Any]) -> Any:
    return kind(np.ascontiguousarray(values, np.float32 if kind is mi.Float else np.uint32).ravel())

"""The scene: specimen, cards, tray and bench; ray intersections and irradiance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from embreex import mesh_construction, rtcore_scene
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles
from specimap_core.errors import SettingsError, UnknownDictionaryError
from specimap_core.geometry.cameras import Pose, rotation_from_vector
from specimap_validation.phantom.noise import NoiseVolume, band_noise
from specimap_validation.phantom.settings import PhantomSettings, Stream
from specimap_validation.phantom.specimen import TRAY_Z_MM, Specimen, build_specimen, displaced

SPECIMEN, CARDS, TRAY, BENCH = range(4)
BENCH_Z_MM = -8.0
_BENCH_HALF_MM = 3000.0
_TRAY_TEXELS = 1024
_IRRADIANCE_CELLS = 128
_LIGHTS = 40
KEY_LIGHTS = np.array([[0.45, -0.35, 0.82], [-0.6, 0.3, 0.74]])


@dataclass(frozen=True)
class Cards:
    """White cards with one marker each.

    ``corners`` (N, 4, 3) mm: top-left, top-right, bottom-right, bottom-left of the upright marker;
    ``outlines`` (N, 4, 3) mm of the cards in the same order; ``white`` (N, n, n) bool, the cells row by row.
    """

    corners: Floats
    outlines: Floats
    white: NDArray[np.bool_]

    def is_white(self, card: NDArray[np.int32], points: Floats) -> NDArray[np.bool_]:
        """Whether points (S, 3) on the cards ``card`` (S,) are white: (S,)."""
        n = self.white.shape[1]
        origin = self.corners[card, 0]
        along, down = self.corners[card, 1] - origin, self.corners[card, 3] - origin
        offset = points - origin
        col = np.floor((offset * along).sum(1) / (along * along).sum(1) * n).astype(int)
        row = np.floor((offset * down).sum(1) / (down * down).sum(1) * n).astype(int)
        inside = (col >= 0) & (col < n) & (row >= 0) & (row < n)
        return np.asarray(~inside | self.white[card, row.clip(0, n - 1), col.clip(0, n - 1)])


@dataclass(frozen=True)
class Hits:
    """First surfaces met by unit rays.

    ``distance`` (S,) mm; ``geometry`` (S,), -1 for none; ``triangle`` (S,) and ``uv`` (S, 2) within it.
    """

    distance: Floats
    geometry: NDArray[np.int32]
    triangle: NDArray[np.int32]
    uv: Singles


class RayCaster:
    """Several meshes in one Embree scene; geometries are numbered as given."""

    def __init__(self, meshes: list[tuple[Floats, NDArray[np.int32]]]) -> None:
        self._scene = rtcore_scene.EmbreeScene()
        self._meshes = [
            mesh_construction.TriangleMesh(self._scene, v.astype(np.float32), f.astype(np.int32)) for v, f in meshes
        ]

    def cast(self, origin: Floats, directions: Floats) -> Hits:
        """First hits of the rays from ``origin`` (3,) along unit ``directions`` (S, 3)."""
        d = np.ascontiguousarray(directions, np.float32)
        o = np.ascontiguousarray(np.broadcast_to(origin.astype(np.float32), d.shape))
        out = self._scene.run(o, d, query="INTERSECT", output=1)
        uv = np.stack([out["u"], out["v"]], 1)
        return Hits(out["tfar"].astype(float), out["geomID"], out["primID"], uv)

    def occluded(self, origins: Floats, direction: Floats) -> NDArray[np.bool_]:
        """Whether something lies in ``direction`` (3,) of each of ``origins`` (S, 3): (S,)."""
        o = np.ascontiguousarray(origins, np.float32)
        d = np.ascontiguousarray(np.broadcast_to(direction.astype(np.float32), o.shape))
        return np.asarray(self._scene.run(o, d, query="OCCLUDED") != -1)


@dataclass(frozen=True)
class Scene:
    """Everything that a camera sees. Irradiance is 1 on an open horizontal surface."""

    specimen: Specimen
    cards: Cards
    caster: RayCaster
    detail: NoiseVolume
    texture_contrast: float
    vertex_irradiance: Singles
    tray_half_mm: float
    tray_maps: Singles
    """(texels, texels, 2): share of speckle, irradiance; rows grow with y."""
    moved: Pose | None = None
    """From the specimen's place in the photos to its place here; None where it is the same."""

    def detail_at(self, points: Floats) -> Singles:
        """Fine brightness detail (S,) of the tissue at points (S, 3) on the specimen; it moves with the tissue."""
        return self.detail(points if self.moved is None else self.moved.inverse().apply(points))

    def tray_at(self, points: Floats) -> tuple[Singles, Singles]:
        """Share of speckle (S,) and irradiance (S,) on the tray under points (S, 3), S < 32768."""
        xy = ((points[:, :2] + self.tray_half_mm) * (_TRAY_TEXELS / (2 * self.tray_half_mm)) - 0.5).astype(np.float32)
        if not len(xy):
            return np.empty(0, np.float32), np.empty(0, np.float32)
        maps = cv2.remap(self.tray_maps, xy[:, None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        return maps[:, 0], maps[:, 1]


def build_scene(settings: PhantomSettings, moved: Pose | None = None) -> Scene:
    """Build specimen, moved by ``moved`` if given, cards and tray of ``settings``, and the light on them.

    Raises as :func:`place_cards` does.
    """
    specimen = build_specimen(settings)
    if moved is not None:
        specimen = displaced(specimen, moved)
    cards = place_cards(settings)
    half = settings.scene_mm + 28
    caster = _caster(specimen, cards.outlines, half)
    # Only the specimen casts shadows: a card a fraction of a millimetre high has none worth rendering.
    shade = RayCaster([(specimen.vertices, specimen.triangles)])
    lights, weights = sky()
    return Scene(
        specimen=specimen,
        cards=cards,
        caster=caster,
        detail=NoiseVolume(settings.rng(Stream.DETAIL), 0.35, 1.6, size=96, slope=0.8),
        texture_contrast=settings.texture_contrast,
        vertex_irradiance=_irradiance(shade, specimen.vertices, specimen.normals, lights, weights),
        tray_half_mm=half,
        tray_maps=_tray_maps(settings, shade, half, lights, weights),
        moved=moved,
    )


def without_cards(scene: Scene) -> Scene:
    """Return the same scene with its cards hidden under the bench."""
    under = scene.cards.outlines - [0, 0, scene.cards.outlines[..., 2].max() - BENCH_Z_MM + 1]
    return replace(scene, caster=_caster(scene.specimen, under, scene.tray_half_mm))


def _caster(specimen: Specimen, outlines: Floats, half: float) -> RayCaster:
    """Geometries in the order of their numbers."""
    quads = [outlines, _square(half, TRAY_Z_MM), _square(_BENCH_HALF_MM, BENCH_Z_MM)]
    return RayCaster([(specimen.vertices, specimen.triangles), *map(_quad_mesh, quads)])


def marker_cells(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """White cells (n, n) of a marker with its black border.

    Raises ``UnknownDictionaryError`` for the name, ``SettingsError`` for an id that the dictionary lacks.
    """
    number = getattr(cv2.aruco, dictionary, None)
    if not dictionary.startswith("DICT_") or not isinstance(number, int):
        raise UnknownDictionaryError(
            f"There is no marker dictionary {dictionary}.", advice="Use a name such as DICT_4X4_50."
        )
    table = cv2.aruco.getPredefinedDictionary(number)
    if not 0 <= marker_id < len(table.bytesList):
        raise SettingsError(
            f"{dictionary} has no marker {marker_id}.",
            advice=f"Use ids from 0 to {len(table.bytesList) - 1}.",
            setting="marker_ids",
        )
    return np.asarray(cv2.aruco.generateImageMarker(table, marker_id, table.markerSize + 2, borderBits=1) > 127)


def place_cards(settings: PhantomSettings) -> Cards:
    """Cards around the specimen, in the order of ``marker_ids``, turned at random, tilted and lifted as set.

    A tilted card is lifted until it clears the tray. Raises as :func:`marker_cells` does.
    """
    white = np.stack([marker_cells(settings.dictionary, i) for i in settings.marker_ids])
    rng = settings.rng(Stream.CARDS)
    n = len(settings.marker_ids)
    square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2
    slack = 2 * np.pi / n - settings.card_mm * 2**0.5 / settings.ring_mm
    angle = np.pi / 4 + 2 * np.pi * np.arange(n) / n + rng.uniform(-0.35, 0.35, n) * min(slack, 0.8)
    corners, outlines = [], []
    for a, spin, tip, share, lift in zip(
        angle,
        rng.uniform(0, 2 * np.pi, n),
        rng.uniform(0, 2 * np.pi, n),
        *rng.uniform(0.3, 1, (2, n)),
        strict=True,
    ):
        tilt = np.radians(settings.card_tilt_deg) * share
        R = rotation_from_vector(tilt * np.array([np.cos(tip), np.sin(tip), 0])) @ rotation_from_vector(
            np.array([0, 0, spin])
        )
        outline = settings.card_mm * square @ R.T
        clearance = TRAY_Z_MM + 0.02 - outline[:, 2].min()
        height = max(settings.card_lift_mm * lift, clearance, 0.0)
        centre = np.array([settings.ring_mm * np.cos(a), settings.ring_mm * np.sin(a), height])
        corners.append(settings.edge_mm * square @ R.T + centre)
        outlines.append(outline + centre)
    return Cards(np.stack(corners), np.stack(outlines), white)


def sky() -> tuple[Floats, Floats]:
    """Directions (L, 3) toward the lights of a bright room with two soft lamps, and their weights (L,)."""
    k = np.arange(_LIGHTS) + 0.5
    z, azimuth = 1 - 0.95 * k / _LIGHTS, k * np.pi * (3 - 5**0.5)
    r = np.sqrt(1 - z**2)
    lights = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], 1)
    lamps = KEY_LIGHTS / np.linalg.norm(KEY_LIGHTS, axis=1, keepdims=True)
    weights = 1 + (np.array([5.0, 2.5]) * np.exp(9 * (lights @ lamps.T - 1))).sum(1)
    return lights, weights / (weights * z).sum()


def _irradiance(caster: RayCaster, points: Floats, normals: Floats, lights: Floats, weights: Floats) -> Singles:
    """Irradiance (S,) at points (S, 3) with normals (S, 3), shadows included."""
    start = points + 0.02 * normals
    # Light that the tray throws back keeps undersides from turning black.
    total = 0.18 * (1 - normals[:, 2]) / 2
    for light, weight in zip(lights, weights, strict=True):
        cosine = normals @ light
        lit = cosine > 0
        seen = np.zeros(len(points))
        seen[lit] = ~caster.occluded(start[lit], light)
        total += weight * seen * np.maximum(cosine, 0)
    return total.astype(np.float32)


def _tray_maps(settings: PhantomSettings, caster: RayCaster, half: float, lights: Floats, weights: Floats) -> Singles:
    texel = 2 * half / _TRAY_TEXELS
    grain = band_noise(settings.rng(Stream.TRAY), (_TRAY_TEXELS,) * 2, 0.55 / texel, 5.0 / texel, 0.7)
    speckle = np.clip(0.4 + 0.3 * settings.texture_contrast * grain, 0, 1)
    centres = (np.arange(_IRRADIANCE_CELLS) + 0.5) / _IRRADIANCE_CELLS * 2 * half - half
    x, y = np.meshgrid(centres, centres)
    points = np.stack([x, y, np.full_like(x, TRAY_Z_MM)], -1).reshape(-1, 3)
    up = np.broadcast_to([0.0, 0, 1], points.shape)
    light = _irradiance(caster, points, up, lights, weights).reshape(x.shape)
    return np.stack([speckle, cv2.resize(light, (_TRAY_TEXELS,) * 2, interpolation=cv2.INTER_LINEAR)], -1).astype(
        np.float32
    )


def _square(half: float, z: float) -> Floats:
    return np.array([[[-half, half, z], [half, half, z], [half, -half, z], [-half, -half, z]]])


def _quad_mesh(quads: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """Quads (N, 4, 3) as vertices and triangles; triangle k belongs to quad k // 2."""
    triangles = 4 * np.arange(len(quads))[:, None, None] + np.array([[0, 2, 1], [0, 3, 2]])
    return quads.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int32)

"""Lamps, room and meshes for Mitsuba, and the light that they throw on surfaces, by path tracing.

Light that a rough surface scatters is the same from all sides. So it is traced once for a specimen and kept at the
surfaces' places, which leaves the photos only what depends on the camera: what is seen, and what the wet coat mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from specimap_core.arrays import Floats, Singles
from specimap_validation.path_traced.settings import TracedSettings
from specimap_validation.phantom import materials
from specimap_validation.phantom.scene import BENCH_Z_MM
from specimap_validation.phantom.specimen import TRAY_Z_MM, Specimen

_BENCH_HALF_MM = 3000.0
_TRAY_CELLS = 160
_TRAY_SMOOTH_CELLS = 1.2
_SCATTER_OF_RGB = np.array([1.3, 0.9, 0.6])
_MOST_RADIANCE = 10.0  # of what other surfaces throw: a path that meets a lamp by chance would leave a bright dot
_OFF_MM = 1e-3
_LAMPS = (
    # Direction, distance mm, radius mm, radiance: a key lamp and a weaker, larger one.
    ((0.45, -0.35, 0.82), 420.0, 30.0, (105.0, 101.0, 95.0)),
    ((-0.6, 0.3, 0.74), 480.0, 45.0, (26.0, 26.6, 28.0)),
)


@dataclass(frozen=True)
class Light:
    """Irradiance as a share of that of the open tray.

    ``vertices`` (V, 3) of the specimen's vertices, spread under the surface; ``tray`` (n, n, 3), rows grow with y, over
    ``-half_mm .. half_mm``. ``radiance_scale``: what a radiance is multiplied by, so that a white surface on the open
    tray has 1.
    """

    vertices: Floats
    tray: Floats
    half_mm: float
    radiance_scale: float


def tray_half_mm(settings: TracedSettings) -> float:
    """Half the side of the tray."""
    return settings.scene_mm + 28


def square(half: float, z: float) -> tuple[Floats, NDArray[np.int32]]:
    """Vertices and triangles of a square about the origin, seen from above."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def tray_and_bench(settings: TracedSettings) -> dict[str, tuple[Floats, NDArray[np.int32]]]:
    """Their meshes by name."""
    return {"tray": square(tray_half_mm(settings), TRAY_Z_MM), "bench": square(_BENCH_HALF_MM, BENCH_Z_MM)}


def trace_light(settings: TracedSettings, specimen: Specimen, albedo: Floats) -> Light:
    """Trace the light on specimen, of albedo (V, 3), and tray. Cards are left out: they are too thin to matter."""
    rgb = materials.linear_rgb()
    grounds = tray_and_bench(settings)
    # The tray's mean: its speckle is far finer than what its light depends on.
    tray = 0.6 * rgb[materials.TRAY] + 0.4 * rgb[materials.TRAY_SPECKLE]
    scene = mi.load_dict(
        {
            "type": "scene",
            "specimen": as_mesh("specimen", specimen.vertices, specimen.triangles, albedo, specimen.normals),
            "tray": as_mesh("tray", *grounds["tray"], tray),
            "bench": as_mesh("bench", *grounds["bench"], rgb[materials.BENCH]),
            **lamps_and_room(),
        }
    )
    half = tray_half_mm(settings)
    centres = (np.arange(_TRAY_CELLS) + 0.5) / _TRAY_CELLS * 2 * half - half
    x, y = np.meshgrid(centres, centres)
    places = np.stack([x, y, np.full_like(x, TRAY_Z_MM)], -1).reshape(-1, 3)
    up = np.broadcast_to([0.0, 0, 1], places.shape)
    n, depth, seed = settings.light_samples, settings.light_depth, settings.seed
    # The tray has few places, so it can have more paths for each.
    on_tray = _irradiance(scene, places, up, 2 * n, depth, 2 * seed).reshape(*x.shape, 3)
    on_vertices = _irradiance(scene, specimen.vertices, specimen.normals, n, depth, 2 * seed + 1)
    full = np.median(on_tray[np.hypot(x, y) > settings.scene_mm], 0)
    spread = _spread_under_surface(on_vertices / full, specimen, settings.scatter_mm * _SCATTER_OF_RGB)
    smooth = ndimage.gaussian_filter(on_tray / full, (_TRAY_SMOOTH_CELLS, _TRAY_SMOOTH_CELLS, 0))
    return Light(spread, smooth, half, float(np.pi / full.mean()))


def as_mesh(
    name: str,
    vertices: Floats,
    triangles: NDArray[np.int32],
    colour: Floats,
    normals: Floats | None = None,
) -> Any:
    """Make Mitsuba's mesh of a diffuse surface of one ``colour`` (3,), or of one for each vertex (V, 3)."""
    varied = colour.ndim == 2
    reflectance = (
        {"type": "mesh_attribute", "name": "vertex_color"}
        if varied
        else {"type": "rgb", "value": list(map(float, colour))}
    )
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    mesh = mi.Mesh(name, len(vertices), len(triangles), has_vertex_normals=normals is not None, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(triangles, np.uint32).ravel()
    if normals is not None:
        parameters["vertex_normals"] = np.ascontiguousarray(normals, np.float32).ravel()
    parameters.update()
    if varied:
        mesh.add_attribute("vertex_color", 3, np.ascontiguousarray(colour, np.float32).ravel())
    return mesh


def lamps_and_room() -> dict[str, Any]:
    """Two round lamps, and around them a room as a map."""
    found: dict[str, Any] = {}
    for i, (toward, distance, radius, radiance) in enumerate(_LAMPS):
        place = np.array(toward) / np.linalg.norm(toward) * distance
        look = mi.ScalarTransform4f().look_at(origin=place.tolist(), target=[0, 0, 0], up=[0, 0, 1])
        found[f"lamp_{i}"] = {
            "type": "disk",
            "to_world": look @ mi.ScalarTransform4f().scale([radius, radius, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}},
        }
    # The map's up is y.
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    found["room"] = {"type": "envmap", "bitmap": mi.Bitmap(_room()), "to_world": upright}
    return found


def _room() -> Singles:
    """Radiance (h, w, 3) of a dim room with a brighter ceiling and two windows, for a wet surface to mirror."""
    h, w = 32, 64
    v, u = np.meshgrid((np.arange(h) + 0.5) / h, (np.arange(w) + 0.5) / w, indexing="ij")
    level = 0.25 + 0.45 * np.clip(1 - 2 * v, 0, 1)
    level += 2.0 * ((np.abs(u - 0.2) < 0.05) & (np.abs(v - 0.3) < 0.1))
    level += 1.2 * ((np.abs(u - 0.7) < 0.08) & (np.abs(v - 0.25) < 0.06))
    return np.asarray(level[..., None] * [0.95, 1.0, 1.06], np.float32)


def _irradiance(scene: Any, places: Floats, normals: Floats, samples: int, depth: int, seed: int) -> Floats:
    """Irradiance (N, 3) at places (N, 3) with normals (N, 3), by ``samples`` paths of at most ``depth`` segments."""
    count = len(places)
    normal = mi.Normal3f(*np.ascontiguousarray(normals.T, np.float32))
    start = mi.Point3f(*np.ascontiguousarray(places.T, np.float32)) + _OFF_MM * normal
    frame = mi.Frame3f(normal)
    place = dr.zeros(mi.SurfaceInteraction3f, count)
    place.p, place.n, place.sh_frame = start, normal, frame
    integrator = mi.load_dict({"type": "path", "max_depth": depth - 1, "hide_emitters": True})
    total = mi.Color3f(0)
    dr.eval(start, normal, frame)
    for k in range(samples):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed * 65536 + k, count)
        # What lamps and room throw here themselves.
        toward, weight = scene.sample_emitter_direction(place, sampler.next_2d(), True)
        total += weight * dr.maximum(dr.dot(toward.d, normal), 0)
        # What other surfaces throw here.
        away = frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        ray = mi.RayDifferential3f(mi.Ray3f(start, away))
        met = scene.ray_intersect_preliminary(ray).is_valid()
        thrown, _, _ = integrator.sample(scene, sampler, ray, active=met)
        total += dr.select(met, dr.pi * dr.minimum(thrown, _MOST_RADIANCE), 0)
        dr.eval(total)
    return np.array(total, float).reshape(3, count).T / samples


def _spread_under_surface(values: Floats, specimen: Specimen, radius_mm: Floats) -> Floats:
    """Spread values (V, C) over the mesh as light that wanders by ``radius_mm`` (C,) under the surface: diffusion."""
    count = len(values)
    tail = specimen.triangles.ravel()
    head = specimen.triangles[:, [1, 2, 0]].ravel()
    linked = sparse.coo_matrix((np.ones(len(tail)), (tail, head)), (count, count)).tocsr()
    linked = ((linked + linked.T) > 0).astype(float)
    neighbours = sparse.diags(1 / np.asarray(linked.sum(1)).ravel()) @ linked
    step2 = float(((specimen.vertices[tail] - specimen.vertices[head]) ** 2).sum(1).mean())
    spread = values.copy()
    for c, radius in enumerate(radius_mm):
        # A step to a neighbour, half the time, adds a quarter of the squared edge to the variance along an axis.
        for _ in range(round(4 * radius**2 / step2)):
            spread[:, c] = (spread[:, c] + neighbours @ spread[:, c]) / 2
    return spread

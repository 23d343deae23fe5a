"""The specimen: a closed lumpy mesh resting on the tray, with the tissue of every vertex."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import Pose, rotation_from_vector
from specimap_validation.phantom import materials
from specimap_validation.phantom.noise import NoiseVolume, smoothstep
from specimap_validation.phantom.settings import PhantomSettings, Stream

TRAY_Z_MM = -0.2
_SUNK_MM = 0.05  # the base lies below the tray's surface, so that no gap shows light
_LOBULE_MM = 3.0


@dataclass(frozen=True)
class Specimen:
    """Vertices (V, 3) mm, triangles (T, 3) wound outward, normals (V, 3), abundance (V, M) summing to 1."""

    vertices: Floats
    triangles: NDArray[np.int32]
    normals: Floats
    abundance: Floats


def build_specimen(settings: PhantomSettings) -> Specimen:
    """Build a lumpy ellipsoid cut flat at the tray, wider above its base (undercut), of the stated extents."""
    rng = settings.rng(Stream.SHAPE)
    axes, base, outward, triangles = ellipsoid(settings)
    # A double, since noise is single: a plain number would leave the product single.
    tall = np.float64(settings.specimen_mm[2])
    lumps = NoiseVolume(rng, 9.0, 30.0, slope=1.5)
    wrinkles = NoiseVolume(rng, 1.3, 5.0, slope=1.2)
    regions = NoiseVolume(rng, 7.0, 25.0)
    crease, fat = lobules(rng, base, axes, regions(base))
    displacement = 0.09 * tall * lumps(base) + fat * (0.55 * crease - 0.3) + 0.13 * wrinkles(base)
    vertices = base + outward * displacement[:, None]
    vertices = rest_on_tray(vertices, settings)
    normals = vertex_normals(vertices, triangles)
    return Specimen(vertices, triangles, normals, tissue_of(rng, base, axes, fat, crease))


def ellipsoid(settings: PhantomSettings) -> tuple[Floats, Floats, Floats, NDArray[np.int32]]:
    """Half axes (3,) mm of what a specimen is shaped from, its surface (V, 3) mm, the surface's normals (V, 3) and
    triangles (T, 3)."""
    directions, triangles = cube_sphere(settings.mesh_divisions)
    size = np.array(settings.specimen_mm)
    # The ellipsoid is cut below its equator: the flank overhangs the base by a small undercut.
    axes = np.array([size[0] / 2, size[1] / 2, size[2] / 1.55])
    outward = directions / axes
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return axes, directions * axes, outward, triangles


def lobules(rng: np.random.Generator, base: Floats, axes: Floats, regions: Singles) -> tuple[Floats, Floats]:
    """How far each place (V, 3) is from the creases between lobules, and how fatty it is, (V,) from 0 to 1.

    ``regions`` (V,): noise that divides fatty from other tissue.
    """
    first, second = lobule_distances(rng, base, axes)
    return smoothstep(0.0, 0.9, second - first), smoothstep(-0.25, 0.25, regions + 0.15)


def displacement(settings: PhantomSettings) -> Pose:
    """Make the rigid map from the specimen's place in the photos to its place in the cube, mm."""
    tilt, turn = np.radians([settings.moved_tilt_deg, settings.moved_deg])
    R = rotation_from_vector(np.array([tilt, 0.0, 0.0])) @ rotation_from_vector(np.array([0.0, 0.0, turn]))
    base = np.array([0.0, 0.0, TRAY_Z_MM])
    return Pose(R, base - R @ base + np.array(settings.moved_mm))


def displaced(specimen: Specimen, motion: Pose) -> Specimen:
    """Move the specimen rigidly; its tissue stays the same."""
    return replace(specimen, vertices=motion.apply(specimen.vertices), normals=specimen.normals @ motion.R.T)


def rest_on_tray(vertices: Floats, settings: PhantomSettings) -> Floats:
    """Cut the underside flat and scale to the exact extents, base just below the tray's surface."""
    low, high = vertices.min(0), vertices.max(0)
    floor = high[2] - (high[2] - low[2]) * 0.775
    flat = vertices.copy()
    flat[:, 2] = np.maximum(flat[:, 2], floor)
    low, high = flat.min(0), flat.max(0)
    x, y, height = settings.specimen_mm
    extent = np.array([x, y, height + _SUNK_MM])
    centre = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return np.asarray((flat - centre) * extent / (high - low) + [0, 0, TRAY_Z_MM - _SUNK_MM])


def lobule_distances(rng: np.random.Generator, points: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Distances (N,), (N,) mm to the nearest and second nearest lobule centre (Worley 1996)."""
    reach = axes + _LOBULE_MM
    count = max(int(8 * reach.prod() / _LOBULE_MM**3), 2)
    tree = cKDTree(rng.uniform(-reach, reach, (count, 3)))
    distances, _ = tree.query(points, k=2)
    return distances[:, 0], distances[:, 1]


def tissue_of(rng: np.random.Generator, points: Floats, axes: Floats, fat: Floats, crease: Floats) -> Floats:
    """Abundance (V, M): fat lobules between fibrous strands, a tumour on the upper side, vessels."""
    streaks = NoiseVolume(rng, 0.8, 3.0)
    vessels = NoiseVolume(rng, 4.0, 14.0)
    stains = NoiseVolume(rng, 2.5, 9.0)
    direction = np.append(rng.uniform(-0.45, 0.45, 2), 0.85)
    centre = direction / np.linalg.norm(direction) * axes
    radius = np.linalg.norm(points - centre, axis=1) + 0.8 * stains(points)

    tumour = 1 - smoothstep(3.2, 5.0, radius)
    vessel = 1 - smoothstep(0.04, 0.10, np.abs(vessels(points)))
    blood = np.clip(0.75 * vessel + 0.6 * smoothstep(1.0, 1.8, stains(points)), 0, 0.85)
    adipose = fat * (0.35 + 0.6 * crease)
    adipose = np.clip(adipose + 0.08 * streaks(points), 0.02, 0.98)

    tissue = np.zeros((len(points), len(materials.MATERIALS)))
    tissue[:, materials.ADIPOSE] = adipose * (1 - 0.9 * tumour)
    tissue[:, materials.FIBROGLANDULAR] = (1 - adipose) * (1 - 0.9 * tumour)
    tissue[:, materials.TUMOUR] = 0.9 * tumour
    tissue *= (1 - blood)[:, None]
    tissue[:, materials.BLOOD] = blood
    return tissue


def cube_sphere(divisions: int) -> tuple[Floats, NDArray[np.int32]]:
    """Unit directions (6 n^2 + 2, 3) and triangles (12 n^2, 3) wound outward: a closed sphere, even cells."""
    n = divisions
    # Equal angles rather than equal steps keep the cells' areas within a factor of 1.4.
    a = np.tan(np.linspace(-np.pi / 4, np.pi / 4, n + 1))
    s, t = np.meshgrid(a, a, indexing="ij")
    one = np.ones_like(s)
    faces = [(one, s, t), (-one, t, s), (t, one, s), (s, -one, t), (s, t, one), (t, s, -one)]
    points = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in faces])

    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    corner = (i * (n + 1) + j).ravel()
    quad = np.stack([corner, corner + n + 1, corner + n + 2, corner + 1], 1)
    face = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    triangles = np.concatenate([face + k * (n + 1) ** 2 for k in range(6)])

    # The faces share their borders: weld equal points, so that normals are smooth across them.
    _, keep, index = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    welded = points[keep]
    directions = welded / np.linalg.norm(welded, axis=1, keepdims=True)
    return directions, index.ravel()[triangles].astype(np.int32)


def vertex_normals(vertices: Floats, triangles: NDArray[np.int32]) -> Floats:
    """Unit normals (V, 3), area-weighted."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    corner = triangles.T.ravel()
    summed = np.stack([np.bincount(corner, np.tile(face[:, k], 3), minlength=len(vertices)) for k in range(3)], 1)
    return np.asarray(summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12))

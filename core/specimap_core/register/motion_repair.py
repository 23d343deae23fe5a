"""Follow a specimen that moved between photos and cube, as a rigid body.

Tiles of the specimen tell its motion together with the cube's camera. The mesh is then moved as the specimen was, the
cube's rays meet it there, and what they meet is looked up where the photos saw it: each spectrum comes to lie on its
own tissue.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Pose, View, rotation_from_vector
from specimap_core.register.camera_fitting import CameraFit, CubeObservations
from specimap_core.register.model_selection import MeasureOffsets, fit_tiles
from specimap_core.register.placement import Placement
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import on_card, raised_mm

ROUNDS = 3
STILL_MM = 0.01
"""Rounds end when the specimen moves by less."""
BASE_SHARES = 0.15, 0.6
"""Heights, in shares of that from which on something is the specimen, between which the mesh begins to move with it."""

MeasureThrough = Callable[[RayCaster], MeasureOffsets]
"""Measures the tiles' offsets on a mesh."""


@dataclass(frozen=True)
class FollowedMotion:
    """``motion``: takes a point of the specimen from where the photos saw it to where the cube did, marker frame, mm;
    ``fit``: of the cube's camera, with what is left of the motion; ``moved_mm``: root mean square over the specimen of
    the distance by which it moved."""

    motion: Pose
    fit: CameraFit
    moved_mm: float

    @property
    def turn_deg(self) -> float:
        """Angle of the rotation, degrees."""
        cosine = (np.trace(self.motion.R) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def follow_motion(
    start: CameraFit,
    observed: CubeObservations,
    measure_through: MeasureThrough,
    caster: RayCaster,
    corners: Floats,
    places: Floats,
) -> FollowedMotion:
    """Refine the motion that ``start`` found, measuring again on the mesh moved by it until nothing moves.

    ``observed``: the corners in the cube; ``corners`` (Q, 4, 3) mm of all markers; ``places`` (N, 3) mm of the
    specimen's surface.
    """
    fitted = start
    motion = _motion_of(fitted)
    for _ in range(ROUNDS):
        there = RayCaster(moved_mesh(caster.mesh, motion, corners))
        seen = measure_through(there)(fitted.camera.view)
        found = None if seen is None else fit_tiles(fitted.camera, observed, seen, moved=True)
        if found is None:
            break
        change = _motion_of(found)
        fitted, motion = found, change @ motion
        at = motion.apply(places)
        if float(np.sqrt(((change.apply(at) - at) ** 2).sum(1).mean())) < STILL_MM:
            break
    return FollowedMotion(motion, fitted, float(np.sqrt(((motion.apply(places) - places) ** 2).sum(1).mean())))


def _motion_of(fitted: CameraFit) -> Pose:
    tiles = fitted.observed.tiles
    if tiles is None:
        return Pose(np.eye(3), np.zeros(3))
    R, middle = rotation_from_vector(fitted.motion[:3]), tiles.middle
    return Pose(R, middle - R @ middle + fitted.motion[3:])


def moved_mesh(mesh: Mesh, motion: Pose, corners: Floats) -> Mesh:
    """The mesh with its specimen moved; cards and tray, with markers' ``corners`` (Q, 4, 3) mm, stay."""
    low, high = (share * raised_mm(corners) for share in BASE_SHARES)
    vertices = mesh.vertices.astype(float)
    share = np.clip((vertices[:, 2] - low) / (high - low), 0, 1)
    share[on_card(mesh.vertices, corners)] = 0
    there = vertices + share[:, None] * (motion.apply(vertices) - vertices)
    turned = np.where(share[:, None] > 0, mesh.normals @ motion.R.T, mesh.normals)
    return replace(mesh, vertices=there.astype(np.float32), normals=turned.astype(np.float32))


def at_rest(placement: Placement, caster: RayCaster) -> Placement:
    """A placement on a moved mesh, as one on the mesh of ``caster``, which the photos saw."""
    where = placement.triangle, placement.barycentric
    xyz = caster.interpolate(caster.mesh.vertices, *where)
    normal = caster.interpolate(caster.mesh.normals, *where)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return replace(placement, xyz=xyz, normal=normal)


def seen_at_rest(view: View, pixels: Floats, there: RayCaster, caster: RayCaster) -> Floats:
    """Places (N, 3) mm on the mesh of ``caster`` that pixels (N, 2) show of the moved mesh ``there``; NaN off it."""
    hits = there.cast(view.origins(pixels), view.world_rays(pixels))
    xyz = caster.interpolate(caster.mesh.vertices, hits.triangle, hits.barycentric)
    xyz[~hits.hit] = np.nan
    return np.asarray(xyz)

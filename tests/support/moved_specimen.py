"""A textured specimen under a cube's camera, moved by a known amount."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at, rotation_from_vector
from specimap_core.pipeline.artefacts import Stage2, load_stage2
from specimap_core.pipeline.outputs import Outputs
from specimap_core.surface.fusion import Mesh, vertex_normals
from specimap_core.surface.raycast import RayCaster
from specimap_validation.phantom.noise import NoiseVolume
from tests.support.scenes import SMALL, bump_mesh

LARGER = replace(SMALL, cube_rows=256, cube_cols=320, bands=6)
"""The small phantom under a finer cube; its photos, and so its mesh, are those of the small one."""


TOLERANCE_MM = 0.12
"""The surface's own error on this phantom, 0.1 mm; measured on eight phantoms the shift is right to 0.06 mm."""


def stage2_of(out: Path) -> Stage2:
    (artefact,) = (out / "stages").glob("adjust-*.npz")
    found = load_stage2(Outputs(out).store, artefact.stem.partition("-")[2])
    assert found is not None
    return found


VIEW = View(Intrinsics.centred(320, 256, 1600.0), look_at(np.array([2.0, -1, 400]), np.zeros(3), np.array([0, 1.0, 0])))


CORNERS = np.array([[[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]]) * 3.4 + np.array(
    [[[24, 24, 0]], [[-24, 24, 0]], [[-24, -24, 0]], [[24, -24, 0]]]
)


def textured(strength: float = 60.0) -> Mesh:
    plain = bump_mesh()
    noise = NoiseVolume(np.random.default_rng(5), 1.5, 6.0)(plain.vertices)
    colours = np.clip(120 + strength * noise[:, None] * [1.0, 0.8, 0.5], 5, 250).astype(np.uint8)
    return replace(plain, colours=colours)


def moved_by(mesh: Mesh, pose: Pose) -> Mesh:
    vertices = pose.apply(mesh.vertices.astype(float)).astype(np.float32)
    return Mesh(vertices, mesh.triangles, vertex_normals(vertices, mesh.triangles), mesh.colours)


def seen(mesh: Mesh, seed: int = 0, noise: float = 0.01, view: View = VIEW) -> NDArray[np.float32]:
    """A linear image of the mesh whose brightness is not that of the photos: the negative of its red."""
    caster = RayCaster(mesh)
    lens = view.intrinsics
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1).reshape(-1, 2).astype(float)
    hits = caster.cast(view.cam_from_world.centre, view.world_rays(pixels))
    grey = np.where(hits.hit, 1 - caster.colours(hits)[:, 0] / 255.0, np.nan)
    grey += noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return grey.reshape(lens.height, lens.width).astype(np.float32)


def turned(degrees: float, shift: Floats) -> Pose:
    return Pose(rotation_from_vector(np.array([0, 0, np.radians(degrees)])), shift)

"""A small phantom whose photos are matched and fused with their true cameras: what is wrong then is depth alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes, Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import Volume, volume_over
from specimap_core.surface.fusion import Mesh, fuse
from specimap_core.surface.refinement import pixel_footprint_mm
from specimap_core.surface.regions import worth_refining
from specimap_core.surface.settings import SurfaceSettings
from specimap_validation.phantom import Phantom, PhantomSettings

CLEAR_MM = 2.0
"""From where, off the mesh, rays look for the true surface: beyond a mesh's errors, short of most opposite flanks."""


@dataclass(frozen=True)
class Matched:
    """Photos with their true cameras, their depth maps, and the mesh fused of these at ``voxel_mm``."""

    phantom: Phantom
    images: list[Bytes]
    lens: Intrinsics
    poses: tuple[Pose, ...]
    volume: Volume
    maps: tuple[DepthMap, ...]
    voxel_mm: float
    mesh: Mesh

    @property
    def greys(self) -> list[Bytes]:
        """(H, W), as the pipeline keeps them."""
        return [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in self.images]

    @property
    def worth(self) -> NDArray[np.bool_]:
        """(V,) what the pipeline refines."""
        return worth_refining(self.mesh.vertices, self.phantom.truth.marker_corners)

    def off_mm(self, mesh: Mesh) -> Floats:
        """How far (V,) vertices lie outside the true surface along their normals; NaN where it is not found there."""
        normals = mesh.normals.astype(float)
        off = self.phantom.scene.caster.cast(mesh.vertices + CLEAR_MM * normals, -normals).distance - CLEAR_MM
        return np.where(np.abs(off) < CLEAR_MM, off, np.nan)


@cache
def matched(seed: int) -> Matched:
    """The scene of a seed, made once."""
    phantom = Phantom(PhantomSettings(seed=seed, photos=14, photo_size=448, mesh_divisions=64))
    images = [image for _, image in phantom.photos()]
    lens = phantom.views[0].intrinsics
    poses = tuple(v.cam_from_world for v in phantom.views)
    volume = volume_over(phantom.truth.marker_corners)
    settings = DepthSettings()
    maps = tuple(dense_depth(images, lens, poses, volume, settings, workers=2))
    voxel_mm = 1.4 * pixel_footprint_mm(lens, poses, volume.centre) / settings.shrinkage(lens)
    return Matched(
        phantom, images, lens, poses, volume, maps, voxel_mm, fuse(list(maps), poses, voxel_mm, SurfaceSettings())
    )

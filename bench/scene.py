"""A finished reconstruction with its truth, for what the parts of the way add to the error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.cube import open_cube
from specimap_core.geometry.cameras import Intrinsics, Pose, View, fit_similarity
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.pipeline.artefacts import Stage1, Stage2
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.register.camera_refinement import refine_camera
from specimap_core.register.corners import CornersInCube, corners_in_cube
from specimap_core.register.cube_markers import find_markers
from specimap_core.register.joint_layout import join_cube
from specimap_core.register.placement import Placement, place_by_camera
from specimap_core.surface.raycast import RayCaster
from specimap_core.truth.judge import SPECIMEN
from specimap_core.truth.truth_file import Truth


class Scene:
    """``refined``: the cube's camera as the run solves it; ``true_camera``: as it was, in the run's frame; ``ours``
    takes the truth's frame into the run's."""

    def __init__(self, folder: Path, truth: Truth, stage1: Stage1, stage2: Stage2, settings: PipelineSettings) -> None:
        self.truth = truth
        self._stage1 = stage1
        cube = open_cube(next((folder / "hsi").glob("*.hdr")))
        found = find_markers(cube, settings.reconstruct.dictionary, stage2.adjusted.marker_ids)
        seen: CornersInCube = corners_in_cube(found, stage2.adjusted, cube.cols)
        joint = join_cube(seen, stage2.adjusted, cube.rows, cube.cols)
        self.adjusted = joint.adjusted
        vertices = (stage2.mesh.vertices * joint.scale).astype(np.float32)
        self.caster = RayCaster(replace(stage2.mesh, vertices=vertices))
        self.refined = refine_camera(joint.seen, joint.by_corners, found, self.caster, self.adjusted.corners)
        self.camera = self.refined.camera.view
        ids = list(truth.marker_ids)
        self.true_corners = truth.marker_corners[[ids.index(i) for i in self.adjusted.marker_ids]]
        _, R, t = fit_similarity(self.true_corners.reshape(-1, 3), self.adjusted.corners.reshape(-1, 3))
        self.ours = Pose(R, t)
        self.true_camera = truth.hsi_view.after(self.ours.inverse())

    def true_photos(self) -> tuple[Intrinsics, tuple[Pose, ...], Floats]:
        """The photos' true lens, poses and corners in the run's frame."""
        names = [Path(n).name for n in self.truth.photo_names]
        used = [names.index(self._stage1.names[p]) for p in self._stage1.reconstruction.photos]
        views = [self.truth.views[i] for i in used]
        poses = tuple(v.cam_from_world @ self.ours.inverse() for v in views)
        corners = self.ours.apply(self.true_corners.reshape(-1, 3)).reshape(-1, 4, 3)
        return views[0].intrinsics, poses, corners

    def placed(self, caster: RayCaster, view: View) -> tuple[Placement, NDArray[np.intp], Floats]:
        """Where ``view`` casts the cube's pixels; which places (n,) are the specimen's, as far as their truth is known,
        and their errors (n,) mm."""
        placed = place_by_camera(view, caster, False)
        rows, cols = placed.pixels[:, 0], placed.pixels[:, 1]
        at = np.flatnonzero(self.truth.hsi_class[rows, cols] == SPECIMEN)
        true = self.ours.apply(self.truth.hsi_xyz[rows[at], cols[at]].astype(float))
        errors = np.linalg.norm(placed.xyz[at] - true, axis=1)
        known = np.isfinite(errors)
        return placed, at[known], errors[known]


def scaled_maps(stage1: Stage1, stage2: Stage2) -> tuple[DepthMap, ...]:
    """The depth maps of stage 1 in mm."""
    factor = np.float32(stage2.adjusted.scale)
    return tuple(replace(m, depth=m.depth * factor) for m in stage1.reconstruction.maps)

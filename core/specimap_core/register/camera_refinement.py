"""Refine the cube's camera by the specimen where the markers leave it open.

Sixteen nearly coplanar corners give the plane's place in the cube to a few hundredths of a pixel, but the direction
of sight and the focal length only as far as perspective shows: at the height of a specimen that leaves 0.02 to 0.1 mm
open, and much more where a marker is out of view or corners are blurred. The photos' own picture of the specimen tells
where it lies to 0.03 mm; corners and specimen together give the camera, each by its standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.notices import Notice
from specimap_core.register.camera_fitting import CameraFit, CubeObservations
from specimap_core.register.camera_models import Model
from specimap_core.register.corners import CornersInCube
from specimap_core.register.cube_camera import CubeCamera
from specimap_core.register.cube_markers import CubeMarkers
from specimap_core.register.model_selection import MeasureOffsets, select_camera
from specimap_core.register.motion_repair import FollowedMotion, follow_motion
from specimap_core.register.specimen_motion import Shift, motion_of_tiles
from specimap_core.register.tile_offsets import measure_tile_offsets
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import raised_places

LOOSE_MM = 0.1
"""Lateral standard deviation at the specimen from which on the camera is called loose."""
EXPLAINED_BY_CAMERA = 3.0
"""A shift within so many standard deviations of the camera is the camera's, not the specimen's."""
MOTION_OVER_MISFIT = 3.0
"""A motion counts as one, and not as a cube that no camera fits, where it is so many times the corners' misfit."""
SQUARE = 0.005
"""An aspect nearer to 1 than this is not reported."""
ROUNDS = 3
CONVERGED_MM = 0.01
"""Rounds end when the specimen moves by less in the cube."""


@dataclass(frozen=True)
class RefinedCamera:
    """The solved ``camera``; ``specimen_used``: whether the specimen took part; ``shift`` of the specimen that is left,
    None where it cannot be measured.

    Lateral standard deviations at the specimen: ``marker_sd_mm`` by the markers alone; ``joint_sd_mm`` by markers and
    specimen, where they were fitted together; ``model_sd_mm`` between camera models that are not ruled out.
    ``misfit_mm``: residual of the best model, 0 where it fits.
    """

    camera: CubeCamera
    marker_sd_mm: float
    specimen_used: bool
    shift: Shift | None
    joint_sd_mm: float | None = None
    model_sd_mm: float = 0.0
    misfit_mm: float = 0.0
    followed: FollowedMotion | None = None

    @property
    def moved(self) -> bool:
        """Whether the specimen lies elsewhere in the cube than in the photos, by so much that a warning is due."""
        shift = self.shift
        return shift is not None and shift.significant and shift.moved_mm > MOTION_OVER_MISFIT * self.misfit_mm

    @property
    def lateral_sd_mm(self) -> float:
        """Lateral standard deviation of a registered pixel of the specimen."""
        if self.shift is not None and self.moved and self.followed is None:
            # Spectra are off their places by this much, and the camera may add its own error.
            return float(np.hypot(self.shift.moved_mm, self.camera_sd_mm))
        return self.camera_sd_mm

    @property
    def camera_sd_mm(self) -> float:
        """Lateral standard deviation that the camera alone causes."""
        if self.joint_sd_mm is not None:
            alone = self.joint_sd_mm
        elif self.specimen_used and self.shift is not None:
            alone = self.marker_sd_mm * self.shift.sigma_mm / float(np.hypot(self.marker_sd_mm, self.shift.sigma_mm))
        else:
            alone = float(np.hypot(self.camera.rms_px * self.camera.pixel_mm, self.marker_sd_mm))
        return float(np.sqrt(alone**2 + self.model_sd_mm**2 + self.misfit_mm**2))

    def warnings(self) -> list[Notice]:
        """Warnings for the report."""
        warnings: list[Notice] = []
        view, aspect = self.camera.view, self.camera.view.intrinsics.aspect
        if isinstance(view, ScanView):
            text = f"The cube was recorded one of its {view.scan} at a time, as markers and specimen show: "
            warnings.append(Notice("cube_camera_not_frame", text + "a push-broom camera was solved."))
        if abs(aspect - 1) > SQUARE:
            text = f"The cube's pixels are {aspect:.3f} times as high as they are wide; this was accounted for."
            warnings.append(Notice("cube_pixels_not_square", text))
        if self.shift is not None and self.moved:
            text = self.shift.message
            if self.followed is not None:
                text += (
                    f" The motion, {self.followed.moved_mm:.1f} mm with a turn of {self.followed.turn_deg:.1f} degrees,"
                    " was followed as that of a rigid body; a bend was not."
                )
            warnings.append(Notice("specimen_moved", text))
        if self.misfit_mm:
            text = f"No camera sees markers and specimen as the cube shows them: about {self.misfit_mm:.2f} mm remain."
            warnings.append(Notice("cube_camera_unfit", text))
        elif self.camera_sd_mm > LOOSE_MM:
            text = f"The markers in the cube leave open where raised tissue lies, by about {self.camera_sd_mm:.1f} mm."
            warnings.append(Notice("cube_camera_loose", text))
        return warnings


def refine_camera(
    seen: CornersInCube,
    by_corners: Mapping[Model, CameraFit],
    found: CubeMarkers,
    caster: RayCaster,
    corners: Floats,
) -> RefinedCamera:
    """Solve the cube's camera by the corners ``seen`` and the specimen.

    ``by_corners``: cameras of every kind by the corners alone; ``found``: the markers with the image they show in;
    ``corners`` (Q, 4, 3) mm of all markers.
    """
    sample = raised_places(caster.mesh.vertices, corners)

    def measure_through(there: RayCaster) -> MeasureOffsets:
        return lambda view: measure_tile_offsets(found.image, view, there, corners, mirrored=found.mirrored)

    measure = measure_through(caster)
    observed = CubeObservations(*seen.flat(), covariance=seen.covariance)
    choice = select_camera(observed, by_corners, sample, measure)
    camera, alone = choice.fit.camera, choice.by_corners.camera
    if not len(sample):
        return RefinedCamera(camera, alone.lateral_sd_mm(seen.flat()[0]), False, None, misfit_mm=choice.misfit_mm)
    marker_sd_mm = alone.lateral_sd_mm(sample)
    joint_sd_mm = camera.lateral_sd_mm(sample) if choice.specimen_used else None
    shift = motion_of_tiles(last) if choice.moved and (last := measure(camera.view)) is not None else None
    found_camera = RefinedCamera(
        camera, marker_sd_mm, choice.specimen_used, shift, joint_sd_mm, choice.ambiguity_mm, choice.misfit_mm
    )
    # Also where it moved by less than calls for a warning: the camera was fitted as if it had.
    if shift is None or shift.moved_mm <= MOTION_OVER_MISFIT * choice.misfit_mm:
        return found_camera
    followed = follow_motion(choice.fit, observed, measure_through, caster, corners, sample)
    joint_sd_mm = followed.fit.specimen_sd_mm(sample)
    return replace(found_camera, camera=followed.fit.camera, joint_sd_mm=joint_sd_mm, followed=followed)

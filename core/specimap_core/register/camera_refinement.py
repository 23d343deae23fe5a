"""The cube's camera from the markers, and from the specimen where they leave it open.

Sixteen nearly coplanar corners give the plane's place in the cube to a few hundredths of a pixel, but the direction
of sight and the focal length only as far as perspective shows: at the height of a specimen that leaves 0.02 to 0.1 mm
open, and much more where a marker is out of view or corners are blurred. The photos' own picture of the specimen tells
where it lies to 0.03 mm; corners and specimen together give the camera, each by its standard deviation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import Floats, View
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.notices import Notice
from specimap_core.register.camera_fitting import Sight
from specimap_core.register.camera_models import FRAME
from specimap_core.register.corners import CornersInCube
from specimap_core.register.cube_camera import Anchor, CubeCamera, solve_camera
from specimap_core.register.cube_markers import CubeMarkers
from specimap_core.register.model_selection import Choice, choose_camera
from specimap_core.register.specimen_motion import LEAST_MARKERS, Shift, shift_of
from specimap_core.register.tile_offsets import Sighting, sight_specimen
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import raised_mm

LOOSE_MM = 0.1
"""Sideways standard deviation at the specimen from which on the result is called loose."""
EXPLAINED_BY_CAMERA = 3.0
"""A shift within so many standard deviations of the camera is the camera's, not the specimen's."""
JOINT_MM = 0.03
"""What all tiles are off together, one standard deviation, where they settle more of a camera than its middle."""
MOVED_OVER_UNFIT = 3.0
"""A motion is told from a cube that no camera fits where it is so many times more than the corners are off."""
SQUARE = 0.005
"""An aspect nearer to 1 than this is not worth a word."""
ROUNDS = 3
CONVERGED_MM = 0.01
"""Rounds end when the specimen moves by less in the cube."""
SAMPLE = 500


@dataclass(frozen=True)
class RefinedCamera:
    """The solved ``camera``; ``open_mm``: how far the markers leave open, sideways, where the specimen lies, one
    standard deviation; ``by_specimen``: whether the specimen had a say; ``shift`` that is left, if it can be told.

    ``joint_mm``: one standard deviation by markers and specimen together, where they were fitted so; ``kinds_mm``: what
    remains open between kinds of camera; ``unfit_mm``: how far the cube contradicts the best of them, 0 where it does
    not.
    """

    camera: CubeCamera
    open_mm: float
    by_specimen: bool
    shift: Shift | None
    joint_mm: float | None = None
    kinds_mm: float = 0.0
    unfit_mm: float = 0.0

    @property
    def moved(self) -> bool:
        """Whether the specimen lies elsewhere in the cube than in the photos."""
        shift = self.shift
        return shift is not None and shift.significant and shift.moved_mm > MOVED_OVER_UNFIT * self.unfit_mm

    @property
    def sideways_mm(self) -> float:
        """Sideways standard deviation of a registered pixel of the specimen."""
        if self.shift is not None and self.moved:
            # Spectra lie beside their places by this much, and the camera may add its own.
            return float(np.hypot(self.shift.moved_mm, self.camera_mm))
        return self.camera_mm

    @property
    def camera_mm(self) -> float:
        """The camera's part of it."""
        if self.joint_mm is not None:
            alone = self.joint_mm
        elif self.by_specimen and self.shift is not None:
            alone = self.open_mm * self.shift.sigma_mm / float(np.hypot(self.open_mm, self.shift.sigma_mm))
        else:
            alone = float(np.hypot(self.camera.rms_px * self.camera.pixel_mm, self.open_mm))
        return float(np.sqrt(alone**2 + self.kinds_mm**2 + self.unfit_mm**2))

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
            warnings.append(Notice("specimen_moved", self.shift.message))
        if self.unfit_mm:
            text = f"No camera sees markers and specimen as the cube shows them: about {self.unfit_mm:.2f} mm remain."
            warnings.append(Notice("cube_camera_unfit", text))
        elif self.camera_mm > LOOSE_MM:
            text = f"The markers in the cube leave open where raised tissue lies, by about {self.camera_mm:.1f} mm."
            warnings.append(Notice("cube_camera_loose", text))
        return warnings


def refine_camera(
    seen: CornersInCube, found: CubeMarkers, rows: int, cols: int, caster: RayCaster, corners: Floats
) -> RefinedCamera:
    """Solve the cube's camera on the corners ``seen``; ``found``: the markers with the image they show in;
    ``corners`` (Q, 4, 3) mm of all markers.

    Raises:
        RegistrationError: no camera above the plane sees the corners there.
    """
    flat = seen.flat()
    try:
        square = solve_camera(*flat, rows, cols)
    except RegistrationError:
        square = None
    vertices = caster.mesh.vertices
    raised = vertices[vertices[:, 2] > raised_mm(corners)].astype(float)
    sample = raised[:: max(1, len(raised) // SAMPLE)]

    def sight(view: View) -> Sighting | None:
        return sight_specimen(found.image, view, caster, corners, mirrored=found.mirrored)

    choice = choose_camera(Sight(*flat), rows, cols, square, sample, sight)
    if choice.model is FRAME and square is not None and not choice.unfit_mm:
        return _refine_square(square, choice, seen, rows, cols, sample, sight)
    camera, alone = choice.fit.camera, choice.alone.camera
    if not len(sample):
        return RefinedCamera(camera, alone.sideways_mm(flat[0]), False, None, unfit_mm=choice.unfit_mm)
    left_open = alone.sideways_mm(sample)
    joint_mm = float(np.hypot(camera.sideways_mm(sample), JOINT_MM)) if choice.by_specimen else None
    shift = shift_of(last) if choice.moved and (last := sight(camera.view)) is not None else None
    return RefinedCamera(camera, left_open, choice.by_specimen, shift, joint_mm, choice.open_mm, choice.unfit_mm)


def _refine_square(
    camera: CubeCamera,
    choice: Choice,
    seen: CornersInCube,
    rows: int,
    cols: int,
    sample: Floats,
    sight: Callable[[View], Sighting | None],
) -> RefinedCamera:
    """A frame camera of square pixels: by its markers, or with the specimen's middle where they leave it open."""
    flat, markers = seen.flat(), len(seen.marker_ids)
    if not len(sample):
        return RefinedCamera(camera, camera.sideways_mm(flat[0]), False, None)
    centre, left_open, settled = sample.mean(0), camera.sideways_mm(sample), False

    def look(camera: CubeCamera) -> Shift | None:
        # However few the markers: it is the camera that is in question here.
        known = choice.sighting
        there = known if known is not None and known.view is camera.view else sight(camera.view)
        return None if there is None else shift_of(there)

    shift = look(camera)
    for _ in range(ROUNDS):
        if shift is None or shift.moved_mm > EXPLAINED_BY_CAMERA * np.hypot(left_open, shift.sigma_mm):
            break
        across = np.array([*shift.shift_mm, 0.0])
        pixel = camera.view.project((centre + across)[None])[0]
        before, camera = (
            camera,
            solve_camera(*flat, rows, cols, anchor=Anchor(centre, pixel, shift.sigma_mm / camera.pixel_mm)),
        )
        settled = True
        shift = look(camera)
        if _apart_mm(before, camera, centre) < CONVERGED_MM:
            break
    if not settled and markers < LEAST_MARKERS:
        shift = None
    unfit_mm = 0.0
    if shift is not None and shift.significant and choice.by_specimen and not choice.moved:
        # Tiles lie elsewhere, but not as those of something that moved as a whole.
        unfit_mm, shift = shift.moved_mm, None
    return RefinedCamera(camera, left_open, settled, shift, kinds_mm=choice.open_mm, unfit_mm=unfit_mm)


def _apart_mm(before: CubeCamera, after: CubeCamera, point: Floats) -> float:
    """How far apart two cameras see a ``point`` (3,)."""
    miss = before.view.project(point[None]) - after.view.project(point[None])
    return float(np.linalg.norm(miss)) * after.pixel_mm

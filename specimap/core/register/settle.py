"""The cube's camera from the markers, and from the specimen where they leave it open.

Sixteen nearly coplanar corners give the plane's place in the cube to a few hundredths of a pixel, but the direction
of sight and the focal length only as far as perspective shows: at the height of a specimen that leaves 0.02 to 0.1 mm
open, and much more where a marker is out of view or corners are blurred. The photos' own picture of the specimen tells
where it lies to 0.03 mm; corners and specimen together give the camera, each by its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap.core.accuracy import CornersInCube
from specimap.core.geometry import Floats
from specimap.core.points import raised_mm
from specimap.core.raycast import RayCaster
from specimap.core.register.camera import Anchor, CubeCamera, solve_camera
from specimap.core.register.cube_markers import CubeMarkers
from specimap.core.register.motion import LEAST_MARKERS, Shift, specimen_shift

LOOSE_MM = 0.1
"""Sideways standard deviation at the specimen from which on the result is called loose."""
EXPLAINED_BY_CAMERA = 3.0
"""A shift within so many standard deviations of the camera is the camera's, not the specimen's."""
ROUNDS = 3
SETTLED_MM = 0.01
"""Rounds end when the specimen moves by less in the cube."""
SAMPLE = 500


@dataclass(frozen=True)
class Settled:
    """The solved ``camera``; ``open_mm``: how far the markers leave open, sideways, where the specimen lies, one
    standard deviation; ``by_specimen``: whether the specimen had a say; ``shift`` that is left, if it can be told."""

    camera: CubeCamera
    open_mm: float
    by_specimen: bool
    shift: Shift | None

    @property
    def moved(self) -> bool:
        """Whether the specimen lies elsewhere in the cube than in the photos."""
        return self.shift is not None and self.shift.significant

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
        if self.by_specimen and self.shift is not None:
            return self.open_mm * self.shift.sigma_mm / float(np.hypot(self.open_mm, self.shift.sigma_mm))
        return float(np.hypot(self.camera.rms_px * self.camera.pixel_mm, self.open_mm))

    def remarks(self) -> list[tuple[str, str]]:
        """What the report should say of it."""
        said: list[tuple[str, str]] = []
        if self.shift is not None and self.moved:
            said.append(("specimen_moved", self.shift.message))
        if self.camera_mm > LOOSE_MM:
            text = f"The markers in the cube leave open where raised tissue lies, by about {self.camera_mm:.1f} mm."
            said.append(("cube_camera_loose", text))
        return said


def settle_camera(
    seen: CornersInCube, found: CubeMarkers, rows: int, cols: int, caster: RayCaster, corners: Floats
) -> Settled:
    """Solve the cube's camera on the corners ``seen``; ``found``: the markers with the image they show in;
    ``corners`` (Q, 4, 3) mm of all markers.

    Raises:
        RegistrationError: no camera above the plane sees the corners there.
    """
    flat = seen.flat()
    camera = solve_camera(*flat, rows, cols)
    vertices = caster.mesh.vertices
    raised = vertices[vertices[:, 2] > raised_mm(corners)].astype(float)
    if not len(raised):
        return Settled(camera, camera.sideways_mm(flat[0]), False, None)
    sample = raised[:: max(1, len(raised) // SAMPLE)]
    centre, left_open, settled = sample.mean(0), camera.sideways_mm(sample), False
    markers = len(seen.marker_ids)

    def look(camera: CubeCamera, markers: int) -> Shift | None:
        return specimen_shift(
            found.image, camera.view, caster, corners, markers_in_cube=markers, mirrored=found.mirrored
        )

    # However few the markers: it is the camera that is in question here.
    shift = look(camera, max(markers, LEAST_MARKERS))
    for _ in range(ROUNDS):
        if shift is None or shift.moved_mm > EXPLAINED_BY_CAMERA * np.hypot(left_open, shift.sigma_mm):
            break
        across = np.array([*shift.shift_mm, 0.0])
        pixel = camera.view.project((centre + across)[None])[0]
        before, camera = camera, solve_camera(
            *flat, rows, cols, anchor=Anchor(centre, pixel, shift.sigma_mm / camera.pixel_mm)
        )
        settled = True
        shift = look(camera, max(markers, LEAST_MARKERS))
        if _apart_mm(before, camera, centre) < SETTLED_MM:
            break
    if not settled and markers < LEAST_MARKERS:
        shift = None
    return Settled(camera, left_open, settled, shift)


def _apart_mm(before: CubeCamera, after: CubeCamera, point: Floats) -> float:
    """How far apart two cameras see a ``point`` (3,)."""
    miss = before.view.project(point[None]) - after.view.project(point[None])
    return float(np.linalg.norm(miss)) * after.pixel_mm

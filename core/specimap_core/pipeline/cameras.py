"""The cameras of a run, gathered for those who draw them."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.pipeline.corners import photo_corners
from specimap_core.register.cube_camera import CubeCamera as SolvedCamera
from specimap_core.register.registration import Registered
from specimap_core.report.cameras import Camera, Cameras, CubeCamera, Matrix, PhotoCamera, Scan

DIGITS = 9
"""A millionth of what any camera is right to."""


def cameras_of(stage1: Stage1, adjusted: Adjusted, registered: Registered) -> Cameras:
    """Gather the photos' cameras, as ``adjusted``, and the cube's, all in the marker frame, mm."""
    lens = adjusted.lens
    photos = [
        PhotoCamera(
            name=seen.name,
            width=lens.width,
            height=lens.height,
            cam_from_world=_matrix(pose),
            camera=_camera(lens),
            residual_px=_rms(np.array(seen.residuals_px, float)),
        )
        # An adjustment may hold more poses than photos.
        for seen, pose in zip(photo_corners(stage1, adjusted), adjusted.poses, strict=False)
    ]
    return Cameras(photos=photos, cube=cube_camera(registered.camera.camera, registered.markers.mirrored))


def cube_camera(solved: SolvedCamera, mirrored: bool) -> CubeCamera:
    """Describe the solved camera of a cube that is stored ``mirrored`` or not."""
    view, lens = solved.view, solved.view.intrinsics
    scan = None
    if isinstance(view, ScanView):
        scan = Scan(
            along=view.scan,
            skew=round(view.skew, DIGITS),
            climb=round(view.climb, DIGITS),
            depth_mm=round(view.depth_mm, DIGITS),
        )
    return CubeCamera(
        width=lens.width,
        height=lens.height,
        cam_from_world=_matrix(view.cam_from_world),
        camera=_camera(lens, "pinhole" if scan is None else "push_broom"),
        scan=scan,
        mirrored=mirrored,
        residual_px=round(solved.rms_px, 4),
    )


def _camera(lens: Intrinsics, model: str = "pinhole") -> Camera:
    return Camera(
        model="pinhole" if model == "pinhole" else "push_broom",
        focal_px=_rounded(lens.focals_px),
        principal_point_px=_rounded(np.array([lens.cx, lens.cy])),
        distortion=_rounded(np.array([lens.k1, lens.k2])),
    )


def _matrix(pose: Pose) -> Matrix:
    found: Matrix = (np.round(pose.matrix[:3], DIGITS) + 0.0).tolist()
    return found


def _rounded(values: Floats) -> list[float]:
    found: list[float] = (np.round(values, DIGITS) + 0.0).tolist()
    return found


def _rms(residuals: Floats) -> float | None:
    """Root mean square length of residuals (M, 8) px, pairs of x and y; None without any."""
    if not residuals.size:
        return None
    return round(float(np.sqrt((residuals.reshape(-1, 2) ** 2).sum(1).mean())), 4)

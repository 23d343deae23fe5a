"""Camera models of a cube, as parameters about a given view, and where a solution of each starts.

Eleven parameters describe all of them: a turn, a shift, the logarithms of the focal length and of the pixel's aspect,
of a scan its skew and climb, and of a frame camera the radial distortion of its lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import Intrinsics, Pose, View, rotation_from_vector
from specimap_core.geometry.pushbroom import Axis, ScanView

Kind = Literal["frame", "frame_aspect", "scan_rows", "scan_columns"]
Scanned = Literal["frame", "scan_rows", "scan_columns"]

FOCAL_RANGE = (0.7, 30.0)
"""Focal lengths tried, in widths of the cube."""
FOCAL_PRIOR_SD = float(np.log(FOCAL_RANGE[1] / FOCAL_RANGE[0])) / 4
"""Standard deviation of the logarithm of the focal length about the middle of the range: only keeps it finite."""
TILT_SD = 0.1
"""Of the sight from the vertical, rad: a telecentric camera that looks aslant sees a plane as one with pixels that are
not square does."""
CLIMB_SD = 0.02
"""Of a scan's motion from level, rad."""
SKEW_SD = 0.05
"""Of a scan's motion from square to its line, rad."""
ASPECT_RANGE = (0.25, 4.0)
"""Heights over widths of a pixel that are believed."""
MODEL_PENALTY = 8.0
"""Chi squared that another model must gain over a frame camera of square pixels."""
RADIAL_SD = 0.004
"""Of the shift that the lens of a frame camera causes at the image's corner, as a share of the corner's distance from
the middle: lenses of hyperspectral cameras distort by up to one per cent there."""
PARAMETERS = 11
PARAMETER_SCALES = np.array([1e-3] * 3 + [1.0] * 3 + [0.1, 0.01, 0.01, 0.01, 0.001])
"""Typical change of each parameter."""


@dataclass(frozen=True)
class Model:
    """A ``kind`` of camera; ``parameters``: which of the eleven it has; ``penalty``: chi squared that it must gain over
    a frame camera of square pixels."""

    kind: Kind
    parameters: tuple[int, ...]
    penalty: float

    @property
    def free(self) -> int:
        """How many parameters it has."""
        return len(self.parameters)

    def step(self, x: Floats) -> Floats:
        """A step of the first ``len(x)`` of its parameters as one of all eleven, for :func:`apply_step`."""
        full = np.zeros(PARAMETERS)
        full[list(self.parameters[: len(x)])] = x
        return full

    @property
    def scan(self) -> Axis | None:
        """What the scan goes along."""
        axis: dict[Kind, Axis] = {"scan_rows": "rows", "scan_columns": "columns"}
        return axis.get(self.kind)

    @property
    def scanned(self) -> Scanned:
        """The kind, whatever the pixels' aspect."""
        return "frame" if self.kind == "frame_aspect" else self.kind


_RADIAL = PARAMETERS - 1
FRAME = Model("frame", (*range(7), _RADIAL), 0.0)
ASPECT = Model("frame_aspect", (*range(8), _RADIAL), MODEL_PENALTY)
SCANS = (
    Model("scan_rows", tuple(range(_RADIAL)), MODEL_PENALTY),
    Model("scan_columns", tuple(range(_RADIAL)), MODEL_PENALTY),
)


def model_of(view: View) -> Model:
    """The model that ``view`` is of."""
    if isinstance(view, ScanView):
        return SCANS[0] if view.scan == "rows" else SCANS[1]
    return FRAME if view.intrinsics.aspect == 1 else ASPECT


def apply_step(view: View, x: Floats) -> View:
    """``view`` turned by ``x[:3]``, shifted by ``x[3:6]``, its focal length ``exp(x[6])`` as long and its distance with
    it; its pixels ``exp(x[7])`` as high; with ``x[8]`` more skew, ``x[9]`` more climb and ``x[10]`` more radial
    distortion at the image's corner."""
    if len(x) < PARAMETERS:
        x = np.append(x, np.zeros(PARAMETERS - len(x)))
    lens, pose = view.intrinsics, view.cam_from_world
    zoom, higher = (float(v) for v in np.exp(x[6:8]))
    turned = rotation_from_vector(x[:3]) @ pose.R
    focal_px, aspect = lens.focal_px * zoom, lens.aspect * higher
    if not isinstance(view, ScanView):
        k1 = (radial_at_corner(lens) + float(x[10])) / _corner_square(lens.width, lens.height, focal_px)
        lens = Intrinsics.centred(lens.width, lens.height, focal_px, k1, aspect=aspect)
        return View(lens, Pose(turned, pose.t * zoom + x[3:6]))
    # Along the scan nothing changes with distance, and lines further apart leave the lens as it is.
    if view.along == 0:
        focal_px *= higher
    lens = Intrinsics.centred(lens.width, lens.height, focal_px, aspect=aspect)
    t = pose.t + x[3:6]
    t[2] = pose.t[2] * zoom + x[5]
    return ScanView(
        lens, Pose(turned, t), view.scan, view.skew + float(x[8]), view.climb + float(x[9]), view.depth_mm * zoom
    )


def radial_at_corner(lens: Intrinsics) -> float:
    """By which share of its distance from the middle the image's corner is shifted by the first radial term."""
    return lens.k1 * _corner_square(lens.width, lens.height, lens.focal_px)


def _corner_square(width: int, height: int, focal_px: float) -> float:
    """Square of the corner's distance from the middle, in focal lengths."""
    return (width**2 + height**2) / 4 / focal_px**2


def at_markers(view: View) -> View:
    """The same camera, the aspect of a scan's pixels counted at the depth of the markers.

    Raises:
        RegistrationError: a scan's camera lies below the markers.
    """
    if not isinstance(view, ScanView):
        return view
    depth = float(view.cam_from_world.t[2])
    if depth <= 0:
        raise no_camera_above()
    lens, ratio = view.intrinsics, view.depth_mm / depth
    if view.along == 1:
        lens = replace(lens, aspect=lens.aspect * ratio)
    else:
        lens = replace(lens, focal_px=lens.focal_px / ratio, aspect=lens.aspect / ratio)
    return replace(view, intrinsics=lens, depth_mm=depth)


def no_camera_above() -> RegistrationError:
    """The error where the cube shows the markers as no camera above them can."""
    return RegistrationError(
        "No camera above the markers sees them as the cube does.",
        advice="Check that cube and photos show the same, unmoved markers.",
    )


def prior_residuals(view: View) -> list[float]:
    """Departures of ``view`` from what is usual, in standard deviations."""
    lens, pose = view.intrinsics, view.cam_from_world
    usual = float(np.sqrt(FOCAL_RANGE[0] * FOCAL_RANGE[1])) * max(lens.width, lens.height)
    off = [float(np.log(lens.focal_px / usual)) / FOCAL_PRIOR_SD]
    if isinstance(view, ScanView):
        s, o = view.along, 1 - view.along
        up = pose.R[:, 2]
        level = up[s] + view.skew * up[o] + view.climb * up[2]
        return [*off, up[o] / TILT_SD, up[s] / TILT_SD, level / CLIMB_SD, view.skew / SKEW_SD]
    return [*off, pose.R[0, 2] / TILT_SD, pose.R[1, 2] / TILT_SD, radial_at_corner(lens) / RADIAL_SD]


@dataclass(frozen=True)
class PlaneAffinity:
    """The corners' plane in the cube as an affine map: pixels are ``A @ (x, y) + b``."""

    A: Floats
    b: Floats

    @staticmethod
    def of(corners: Floats, pixels: Floats) -> PlaneAffinity:
        """Least squares over corners (N, 3) and pixels (N, 2).

        Raises:
            RegistrationError: the cube shows the plane from below.
        """
        answer = np.linalg.lstsq(np.c_[corners[:, :2], np.ones(len(corners))], pixels, rcond=None)[0].T
        if not np.isfinite(answer).all() or np.linalg.det(answer[:, :2]) >= 0:
            raise no_camera_above()
        return PlaneAffinity(np.asarray(answer[:, :2], float), np.asarray(answer[:, 2], float))

    @property
    def aspect(self) -> float:
        """Height of a pixel over its width, seen straight down."""
        across, down = np.linalg.norm(self.A, axis=1)
        return float(across / down)

    def scan(self, axis: Axis, rows: int, cols: int, focal_px: float) -> ScanView:
        """A push-broom camera straight above that sees the plane so."""
        s = 1 if axis == "rows" else 0
        o = 1 - s
        down = np.array([0, 0, -1.0])
        along = np.array([*self.A[s], 0.0]) / np.linalg.norm(self.A[s])
        line = np.cross(along, down) if s == 1 else np.cross(down, along)
        span = float(self.A[o] @ line[:2])
        skew = -float(self.A[o] @ along[:2]) / span
        fine = float(np.linalg.norm(self.A[s]))
        lens = Intrinsics.centred(cols, rows, focal_px)
        depth = focal_px / span
        # Pixels in a millimetre at that depth, along the line and along the scan.
        aspect = span / fine if s == 1 else fine / span
        if s == 0:
            lens = replace(lens, focal_px=focal_px * aspect)
        lens = replace(lens, aspect=aspect)
        middle = np.array([lens.cx, lens.cy])
        t = np.empty(3)
        t[s] = (self.b[s] - middle[s]) / fine
        t[o] = (self.b[o] - middle[o]) / span + skew * t[s]
        t[2] = depth
        R = np.empty((3, 3))
        R[s], R[o], R[2] = along, line, down
        return ScanView(lens, Pose(R, t), axis, skew, 0.0, depth)


def in_square_pixels(pixels: Floats, aspect: float, rows: int) -> Floats:
    """Pixels (N, 2) as they would be if rows were as high as columns are wide, about the image's middle."""
    middle = (rows - 1) / 2
    return np.stack([pixels[:, 0], middle + (pixels[:, 1] - middle) * aspect], -1)

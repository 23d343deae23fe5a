"""Cameras and transforms, and the one place where pixel conventions are converted.

Conventions: ``cam_from_world`` maps world millimetres into a camera frame with x right, y down, z forward.
A pixel's centre has integer coordinates (OpenCV). COLMAP puts the centre of the first pixel at (0.5, 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats

SMALL_RAD = 1e-8
"""Turns below this follow from the series, where the exact form would divide by zero."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with two radial terms (OpenCV's k1, k2).

    ``focal_px``, ``cx``, ``cy`` in pixels of an image of ``width`` x ``height``; centres at integers. ``aspect``:
    height of a pixel over its width; ``focal_px`` counts widths.
    """

    width: int
    height: int
    focal_px: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    aspect: float = 1.0

    @staticmethod
    def centred(
        width: int, height: int, focal_px: float, k1: float = 0.0, k2: float = 0.0, aspect: float = 1.0
    ) -> Intrinsics:
        """Intrinsics whose principal point is the image's centre."""
        return Intrinsics(width, height, focal_px, (width - 1) / 2, (height - 1) / 2, k1, k2, aspect)

    @property
    def focals_px(self) -> Floats:
        """Focal length in widths and in heights of a pixel, (2,)."""
        return np.array([self.focal_px, self.focal_px / self.aspect])

    @property
    def matrix(self) -> Floats:
        """K, (3, 3)."""
        fx, fy = self.focals_px
        return np.array([[fx, 0, self.cx], [0, fy, self.cy], [0, 0, 1.0]])

    @property
    def distortion(self) -> Floats:
        """OpenCV's (k1, k2, p1, p2)."""
        return np.array([self.k1, self.k2, 0.0, 0.0])

    def project(self, points_cam: Floats) -> Floats:
        """Points (..., 3) in the camera frame to pixels (..., 2). Points behind the camera give nonsense."""
        # Each axis by itself: fits project a few points at every step, and sums over two numbers take most of that.
        x, y = points_cam[..., 0] / points_cam[..., 2], points_cam[..., 1] / points_cam[..., 2]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + self.k2 * r2)
        fx, fy = self.focals_px
        pixels = np.empty((*points_cam.shape[:-1], 2))
        pixels[..., 0] = x * radial * fx + self.cx
        pixels[..., 1] = y * radial * fy + self.cy
        return pixels

    def rays(self, pixels: Floats) -> Floats:
        """Directions (..., 3) with z = 1 in the camera frame of the pixels (..., 2), distortion undone."""
        distorted = (np.asarray(pixels, float) - [self.cx, self.cy]) / self.focals_px
        xy = distorted
        if self.k1 or self.k2:
            for _ in range(8):  # fixed point; converges to 1e-9 for phone lenses
                r2 = (xy * xy).sum(-1, keepdims=True)
                xy = distorted / (1 + r2 * (self.k1 + self.k2 * r2))
        return np.concatenate([xy, np.ones_like(xy[..., :1])], -1)

    def scaled(self, factor: float, down: float | None = None) -> Intrinsics:
        """The same lens for an image resized by ``factor``, its rows by ``down`` if that is another."""
        down = factor if down is None else down
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * down),
            focal_px=self.focal_px * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
            aspect=self.aspect * factor / down,
        )


@dataclass(frozen=True)
class Pose:
    """A rigid transform ``x_cam = R x_world + t``; R (3, 3), t (3,) mm."""

    R: Floats
    t: Floats

    @property
    def centre(self) -> Floats:
        """The camera's centre in the world, (3,) mm."""
        return np.asarray(-self.R.T @ self.t)

    def apply(self, points: Floats) -> Floats:
        """World points (..., 3) into the camera frame."""
        return np.asarray(points @ self.R.T + self.t)

    def inverse(self) -> Pose:
        """``world_from_cam``."""
        return Pose(self.R.T.copy(), self.centre)

    def __matmul__(self, other: Pose) -> Pose:
        """``(a @ b)`` first applies b, then a."""
        return Pose(self.R @ other.R, self.R @ other.t + self.t)

    @property
    def matrix(self) -> Floats:
        """(4, 4) homogeneous."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.R, self.t
        return m


@dataclass(frozen=True)
class View:
    """A camera at its place: what a photo or a cube was taken with."""

    intrinsics: Intrinsics
    cam_from_world: Pose

    def project(self, points: Floats) -> Floats:
        """World points (..., 3) mm to pixels (..., 2)."""
        return self.intrinsics.project(self.cam_from_world.apply(points))

    def world_rays(self, pixels: Floats) -> Floats:
        """Unit directions (..., 3) in the world of the pixels' rays; they start at the camera's centre."""
        d = self.intrinsics.rays(pixels) @ self.cam_from_world.R
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def origins(self, pixels: Floats) -> Floats:
        """Where the rays of pixels (..., 2) start, mm: (..., 3), or (3,) where all start at one place."""
        del pixels
        return self.cam_from_world.centre

    def eyes(self, points: Floats) -> Floats:
        """Whence points (..., 3) are seen, mm: (..., 3), or (3,) where all are seen from one place."""
        del points
        return self.cam_from_world.centre

    def mm_per_px(self, depth_mm: float) -> Floats:
        """What a pixel spans across and down, (2,) mm, at ``depth_mm``."""
        return np.asarray(depth_mm / self.intrinsics.focals_px)

    def scaled(self, factor: float, down: float | None = None) -> View:
        """The same camera for an image resized by ``factor``, its rows by ``down`` if that is another."""
        return replace(self, intrinsics=self.intrinsics.scaled(factor, down))

    def after(self, motion: Pose) -> View:
        """The same camera for a world whose points ``motion`` takes into this one."""
        return replace(self, cam_from_world=self.cam_from_world @ motion)


def rotation_from_vector(rvec: Floats) -> Floats:
    """Rotation vectors (..., 3) rad to matrices (..., 3, 3) (Rodrigues)."""
    if rvec.ndim == 1:
        return _one_rotation(*(float(v) for v in rvec))
    theta = np.linalg.norm(rvec, axis=-1)[..., None, None]
    k = skew(rvec)
    small = theta < SMALL_RAD
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + a * k + b * (k @ k))


def _one_rotation(x: float, y: float, z: float) -> Floats:
    """The same of a single vector. Fits call it at every step, and arrays of three numbers take ten times as long."""
    theta = math.sqrt(x * x + y * y + z * z)
    small = theta < SMALL_RAD
    a = 1.0 if small else math.sin(theta) / theta
    b = 0.5 if small else (1 - math.cos(theta)) / theta**2
    return np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )


def skew(v: Floats) -> Floats:
    """Vectors (..., 3) to their cross product matrices (..., 3, 3)."""
    zero = np.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)


def fit_similarity(source: Floats, target: Floats, *, with_scale: bool = False) -> tuple[float, Floats, Floats]:
    """Scale, R (3, 3), t (3,) with ``target ~ scale * R source + t`` in the least squares (Umeyama 1991).

    ``source`` and ``target``: (N, 3), N >= 3, not collinear. The scale is 1 unless ``with_scale``.
    """
    ms, mt = source.mean(0), target.mean(0)
    a, b = source - ms, target - mt
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = (u * d) @ vt
    scale = float((s * d).sum() / (a * a).sum()) if with_scale else 1.0
    return scale, R, mt - scale * R @ ms


def look_at(eye: Floats, target: Floats, up: Floats) -> Pose:
    """``cam_from_world`` of a camera at ``eye`` looking at ``target`` with ``up`` upward in the image."""
    z = target - eye
    z = z / np.linalg.norm(z)
    x = np.cross(z, up)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ eye)

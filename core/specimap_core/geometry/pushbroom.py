"""A push-broom camera: a line of pixels, and the scene or the camera moved on from line to line.

Along the line it sees in perspective, across it in steps of one length (the linear push-broom camera of Gupta and
Hartley, 1997). Raised tissue leans away from the middle along the line, and not at all, or all to one side, along the
scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View

Axis = Literal["rows", "columns"]


@dataclass(frozen=True)
class ScanView(View):
    """A push-broom camera at its place.

    ``scan``: what the cube holds one of for each line: ``rows`` or ``columns``. The camera's frame is that of the line
    through the image's middle: z along its middle ray, one axis along the line, the other across the plane in which it
    sees. While the scene passes by 1 mm across that plane, the camera moves ``skew`` mm along the line and ``climb`` mm
    along z. ``depth_mm``: at this depth a step from line to line is as long as the lens says (``aspect`` times as
    long as a pixel is wide). The lens has no distortion.
    """

    scan: Axis = "rows"
    skew: float = 0.0
    climb: float = 0.0
    depth_mm: float = 1.0

    @property
    def along(self) -> int:
        """Axis of the image along which the scan goes: 0 for x, 1 for y."""
        return 1 if self.scan == "rows" else 0

    @property
    def step_px(self) -> float:
        """Lines in a millimetre of the scan."""
        return float(self.intrinsics.focals_px[self.along]) / self.depth_mm

    @property
    def _travel(self) -> Floats:
        """Motion of the camera over 1 mm of the scan, in its own frame (3,)."""
        travel = np.array([self.skew, self.skew, self.climb])
        travel[self.along] = 1.0
        return travel

    def project(self, points: Floats) -> Floats:
        """World points (..., 3) mm to pixels (..., 2)."""
        lens, s, o = self.intrinsics, self.along, 1 - self.along
        q = self.cam_from_world.apply(points)
        middle = np.array([lens.cx, lens.cy])
        out = np.empty((*q.shape[:-1], 2))
        out[..., s] = middle[s] + self.step_px * q[..., s]
        depth = q[..., 2] - self.climb * q[..., s]
        out[..., o] = middle[o] + lens.focals_px[o] * (q[..., o] - self.skew * q[..., s]) / depth
        return out

    def world_rays(self, pixels: Floats) -> Floats:
        """Unit directions (..., 3) in the world of the pixels' rays; they start at :meth:`origins`."""
        lens, o = self.intrinsics, 1 - self.along
        pixels = np.asarray(pixels, float)
        d = np.zeros((*pixels.shape[:-1], 3))
        d[..., o] = (pixels[..., o] - (lens.cx, lens.cy)[o]) / lens.focals_px[o]
        d[..., 2] = 1
        d = d @ self.cam_from_world.R
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def mm_per_px(self, depth_mm: float) -> Floats:
        """What a pixel spans across and down, (2,) mm, at ``depth_mm``."""
        span = np.asarray(depth_mm / self.intrinsics.focals_px)
        span[self.along] = 1 / self.step_px
        return span

    def origins(self, pixels: Floats) -> Floats:
        """Where the rays of pixels (..., 2) start, mm: (..., 3)."""
        lens, s = self.intrinsics, self.along
        way = (np.asarray(pixels, float)[..., s] - (lens.cx, lens.cy)[s]) / self.step_px
        return self._at(way)

    def eyes(self, points: Floats) -> Floats:
        """Whence points (..., 3) are seen, mm: (..., 3)."""
        return self._at(self.cam_from_world.apply(points)[..., self.along])

    def _at(self, way: Floats) -> Floats:
        """The camera's places in the world (..., 3) after ``way`` (...) mm of the scan."""
        return np.asarray((way[..., None] * self._travel - self.cam_from_world.t) @ self.cam_from_world.R)


@dataclass(frozen=True)
class WobblyScan(ScanView):
    """A push-broom camera whose stage runs ahead and behind by ``wobble_mm``, twice over the whole scan."""

    wobble_mm: float = 0.0

    def project(self, points: Floats) -> Floats:
        """World points (..., 3) mm to pixels (..., 2)."""
        even = super().project(points)
        pixels = even.copy()
        for _ in range(20):
            pixels[..., self.along] = even[..., self.along] - self._ahead_px(pixels)
        return pixels

    def origins(self, pixels: Floats) -> Floats:
        """Where the rays of pixels (..., 2) start, mm: (..., 3)."""
        even = np.array(pixels, float)
        even[..., self.along] += self._ahead_px(even)
        return super().origins(even)

    def _ahead_px(self, pixels: Floats) -> Floats:
        length = (self.intrinsics.width, self.intrinsics.height)[self.along]
        return np.asarray(self.wobble_mm * self.step_px * np.sin(4 * np.pi * pixels[..., self.along] / length))

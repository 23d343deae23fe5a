"""A phantom as MASt3R would see it: exact points, depths and cameras in network pixels."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap.core.acquisition import AcquisitionSettings, Photo, photo_paths, read_photos
from specimap.core.geometry import Floats, Intrinsics, Pose, View
from specimap.core.phantom import PhantomSettings
from specimap.core.phantom.phantom import Phantom
from specimap.core.reconstruct.backend import CornersInPhotos, corners_in_photos, detect_in_photos
from specimap.core.reconstruct.mast3r.images import Preparation, plan_preparation

NEEDS = ("torch", "roma", "scipy", "cv2", "PIL", "einops", "huggingface_hub", "trimesh", "tqdm", "matplotlib")
"""What upstream's alignment imports; torchvision aside, for which there is a stand-in."""


@dataclass(frozen=True)
class Seen:
    """A phantom's photos with what is exactly there: ``points`` (N, H, W, 3) world mm, ``views`` in network pixels."""

    photos: list[Photo]
    corners: CornersInPhotos
    plan: Preparation
    images: NDArray[np.uint8]
    views: list[View]
    points: NDArray[np.float32]

    @property
    def depth(self) -> NDArray[np.float32]:
        """(N, H, W) mm."""
        return np.stack([
            v.cam_from_world.apply(p.astype(float))[..., 2] for v, p in zip(self.views, self.points, strict=True)
        ]).astype(np.float32)  # fmt: skip

    @property
    def poses(self) -> Floats:
        """(N, 3, 4) ``cam_from_world``."""
        return np.stack([v.cam_from_world.matrix[:3] for v in self.views])


def see(folder: Path, settings: PhantomSettings, size_px: int) -> Seen:
    """What there is to see of the phantom of ``settings``, written to ``folder`` before."""
    photos, _ = read_photos(photo_paths(folder), AcquisitionSettings())
    found = detect_in_photos(photos, "DICT_4X4_50", workers=2, progress=lambda share: None)
    plan = plan_preparation(photos[0].size, size_px)
    phantom = Phantom(settings)
    views, points = [], []
    width, height = plan.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(float)
    for view in phantom.views:
        lens = view.intrinsics
        cx, cy = plan.to_network(np.array([lens.cx, lens.cy]))
        focal = lens.focal_px * float(plan.scale[0])
        views.append(View(Intrinsics(width, height, focal, float(cx), float(cy)), view.cam_from_world))
        rays, eye = views[-1].world_rays(pixels), view.cam_from_world.centre
        hits = phantom.scene.caster.cast(eye, rays)
        points.append((eye + rays * hits.distance[:, None]).reshape(height, width, 3))
    return Seen(
        photos, corners_in_photos(photos, found, "DICT_4X4_50"), plan, np.stack([plan.apply(p.image) for p in photos]),
        views, np.stack(points).astype(np.float32),
    )  # fmt: skip


def answer_of(
    seen: Seen, *, unit_mm: float = 1000.0, frame: Pose | None = None, focal_factor: float = 1.0
) -> dict[str, NDArray[np.float64]]:
    """The arrays that the child returns, exact but for ``focal_factor``, in another frame and unit."""
    frame = frame or Pose(np.eye(3), np.zeros(3))
    matrices = []
    for view in seen.views:
        to_world = (view.cam_from_world @ frame.inverse()).inverse().matrix
        to_world[:3, 3] /= unit_mm
        matrices.append(to_world)
    return {
        "focal": np.array([v.intrinsics.focal_px * focal_factor for v in seen.views]),
        "centre": np.array([[v.intrinsics.cx, v.intrinsics.cy] for v in seen.views]),
        "cam_to_world": np.stack(matrices),
        "depth": seen.depth.astype(float) / unit_mm,
        "confidence": np.full(seen.depth.shape, 5.0),
    }


def upstream() -> tuple[Path, str | None]:
    """The checkout and the interpreter to test with; skips where one is missing, and says what."""
    home, python = os.environ.get("SPECIMAP_MAST3R_HOME"), os.environ.get("SPECIMAP_MAST3R_PYTHON")
    if not home:
        pytest.skip("SPECIMAP_MAST3R_HOME names no checkout of MASt3R")
    program = f"import {', '.join(NEEDS)}"
    import sys

    done = subprocess.run([python or sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    if done.returncode:
        pytest.skip(f"the interpreter for MASt3R lacks a module: {done.stderr.strip().splitlines()[-1]}")
    return Path(home), python

"""A phantom as MASt3R would see it: exact points, depths and cameras in network pixels."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.bundle_adjust.adjust import AdjustSettings, Form, adjust
from specimap_core.geometry.cameras import Intrinsics, Pose, View, fit_similarity
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photos
from specimap_core.reconstruct.backend import (
    CornersInPhotos,
    Reconstruction,
    ReconstructSettings,
    corners_in_photos,
    detect_in_photos,
)
from specimap_core.reconstruct.backends.mast3r.backend import Mast3rBackend
from specimap_core.reconstruct.backends.mast3r.images import Preparation, plan_preparation
from specimap_core.reconstruct.backends.mast3r.settings import NEEDED, Mast3rSettings
from specimap_core.truth.truth_file import Truth
from specimap_validation.phantom import PhantomSettings
from specimap_validation.phantom.phantom import Phantom

SCRIPT = Path(__file__).with_name("mast3r_scripted.py")
CLOSE_MM = 0.15
"""Median distance of exact depth from truth, after the cameras were solved from corners: a corner is seen to 0.2 px of
0.2 mm, and depth is sampled at markers of 20 network pixels."""

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
        return np.stack(
            [v.cam_from_world.apply(p.astype(float))[..., 2] for v, p in zip(self.views, self.points, strict=True)]
        ).astype(np.float32)

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
        photos,
        corners_in_photos(photos, found, "DICT_4X4_50"),
        plan,
        np.stack([plan.apply(p.image) for p in photos]),
        views,
        np.stack(points).astype(np.float32),
    )


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


def scripted_settings(folder: Path, size_px: int) -> Mast3rSettings:
    """Settings with a checkout and weights in ``folder`` that pass where nothing reads them."""
    home = folder / "checkout"
    for part in NEEDED:
        (home / part).parent.mkdir(parents=True, exist_ok=True)
        (home / part).touch()
    (folder / "weights.pth").write_bytes(b"weights")
    return Mast3rSettings(home=home, weights=folder / "weights.pth", size_px=size_px, cache=folder / "cache")


def reconstruct(
    seen: Seen,
    arrays: dict[str, Array],
    settings: Mast3rSettings,
    monkeypatch: pytest.MonkeyPatch,
    *,
    hold_to_markers: bool = True,
) -> Reconstruction:
    """Stage 1 on what the child is scripted to answer."""
    assert settings.cache is not None
    path = settings.cache.with_name("answer.npz")
    np.savez(path, **arrays)  # type: ignore[arg-type]
    monkeypatch.setenv("ANSWER", str(path))
    shares: list[float] = []
    found = Mast3rBackend(settings, SCRIPT).reconstruct(
        seen.photos,
        seen.corners,
        ReconstructSettings(hold_to_markers=hold_to_markers),
        workers=2,
        progress=shares.append,
    )
    assert list(settings.cache.iterdir()) == []
    assert shares == sorted(shares)
    assert 0.9 < shares[-1] <= 1
    return found


def true_points(found: Reconstruction, seen: Seen) -> list[Floats]:
    """What is truly there (n, 3) at the known depths of each map, in their order."""
    true = []
    for m in found.maps:
        rows, cols = np.nonzero(m.depth)
        # The map is a part of the photo: its principal point tells which.
        cx, cy = seen.plan.to_network(np.array([found.lens.cx, found.lens.cy]))
        left, top = round(cx - m.intrinsics.cx), round(cy - m.intrinsics.cy)
        true.append(seen.points[found.photos[m.photo]][rows + top, cols + left].astype(float))
    return true


def adjusted_errors_mm(found: Reconstruction, seen: Seen, truth: Truth, form: Form) -> Floats:
    """Distances of all points from what is truly there, once stage 2 refined the poses; laid on the true corners."""
    done = adjust(found.lens, found.poses, seen.corners.seen, seen.corners.marker_ids, AdjustSettings(form))
    rows = [list(truth.marker_ids).index(i) for i in done.marker_ids]
    _, R, t = fit_similarity(done.corners.reshape(-1, 3), truth.marker_corners[rows].reshape(-1, 3))
    apart = []
    for m, true in zip(found.maps, true_points(found, seen), strict=True):
        scaled = replace(m, depth=m.depth * np.float32(done.scale))
        apart.append(np.linalg.norm(scaled.points(done.poses[m.photo]) @ R.T + t - true, axis=1))
    return np.concatenate(apart)


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

"""Fusing depth: what gives no surface is refused, not passed on as a library's exception."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specimap_core.errors import DepthNotFoundError
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.reconstruct.dense.volume import Volume, inside_volume
from specimap_core.surface.fusion import fuse
from specimap_core.surface.settings import SurfaceSettings

LENS = Intrinsics.centred(40, 30, 50.0)
EMPTY = DepthMap(
    0, np.eye(3), LENS, np.zeros((30, 40), np.float32), np.zeros((30, 40), np.uint8), np.zeros((30, 40, 3), np.uint8)
)
POSES = (Pose(np.eye(3), np.zeros(3)),)


@pytest.mark.parametrize("maps", [[], [EMPTY], [EMPTY, EMPTY]])
def test_no_depth_is_refused(maps: list[DepthMap]) -> None:
    with pytest.raises(DepthNotFoundError) as caught:
        fuse(maps, POSES, 0.3, SurfaceSettings())
    assert caught.value.details["maps"] == len(maps)


def test_one_photo_alone_gives_no_surface() -> None:
    alone = replace(EMPTY, depth=np.full((30, 40), 100, np.float32))
    with pytest.raises(DepthNotFoundError):
        fuse([alone], POSES, 1.0, SurfaceSettings())


def test_depth_outside_the_volume_is_none() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
    depth = np.full((30, 40), 100, np.float32)
    volume = Volume(np.array([-20.0, -10.0, 90.0]), np.array([20.0, 10.0, 96.0]))
    kept = inside_volume(depth, LENS, pose.R, pose, volume)
    rows, cols = np.indices(depth.shape)
    x, y = (cols - LENS.cx) * 2.0, (rows - LENS.cy) * 2.0
    assert ((kept > 0) == ((abs(x) <= 20) & (abs(y) <= 10))).all()
    assert not inside_volume(depth, LENS, pose.R, pose, replace(volume, high=np.array([20.0, 10.0, 94.0]))).any()

"""What COLMAP's PatchMatch is given, and how its answer is read."""

from __future__ import annotations

import struct
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at
from specimap_core.reconstruct.dense import patchmatch
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.patchmatch_child import (
    WATCH_SECONDS,
    depth_file,
    image_name,
    read_depth,
    run,
    write_workspace,
)
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import Volume

LENS = Intrinsics(200, 160, 300.0, 101.5, 77.25, 0.08, -0.02)
UP = np.array([0.0, 0, 1])
VOLUME = Volume(np.array([-30.0, -30, -2]), np.array([30.0, 30, 20]))


def ring(count: int = 12, distance_mm: float = 150.0) -> tuple[Pose, ...]:
    """Cameras all around, 45 to 60 degrees up."""
    poses = []
    for k in range(count):
        azimuth, up = 2 * np.pi * k / count, np.radians(45 + 15 * (k % 2))
        eye = distance_mm * np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        poses.append(look_at(eye, np.array([0.0, 0, 3]), UP))
    return tuple(poses)


def written(folder: Path, lens: Intrinsics, poses: tuple[Pose, ...], images: list[NDArray[np.uint8]]) -> None:
    plain = patchmatch.pinhole(lens)
    write_workspace(
        folder,
        patchmatch.undistorted(images, lens),
        np.array([plain.focal_px, plain.cx, plain.cy]),
        np.stack([p.R for p in poses]),
        np.stack([p.t for p in poses]),
        patchmatch.choose_sources(poses, VOLUME.centre, DepthSettings()),
    )


def test_colmap_reads_our_cameras_to_a_thousandth_of_a_pixel(tmp_path: Path) -> None:
    poses = ring()
    written(tmp_path, LENS, poses, [np.zeros((160, 200, 3), np.uint8)] * len(poses))
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert model.num_reg_images() == len(poses)
    points = np.random.default_rng(0).uniform(VOLUME.low, VOLUME.high, (50, 3))
    for k, pose in enumerate(poses):
        image = model.find_image_with_name(image_name(k))
        theirs = np.stack([image.project_point(p) for p in points])
        # PatchMatch takes a pixel's column and row for its coordinates: no half pixel lies between the two.
        ours = View(patchmatch.pinhole(LENS), pose).project(points)
        assert np.abs(theirs - ours).max() < 1e-3
    camera = model.camera(1)
    assert camera.model.name == "PINHOLE"
    assert (camera.width, camera.height) == (200, 160)


def test_undistorted_photos_show_what_the_pinhole_camera_sees(tmp_path: Path) -> None:
    y, x = np.mgrid[:160, :200]
    at = np.array([172.3, 133.6])  # near a corner, where the lens bends most
    dot = np.asarray(255 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 18), np.uint8)
    written(tmp_path, LENS, ring(6), [np.repeat(dot[..., None], 3, 2)] * 6)
    stored = cv2.imread(str(tmp_path / "images" / image_name(5)), cv2.IMREAD_GRAYSCALE)
    assert stored is not None
    weight = stored.astype(float)
    centre = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    # Rounding to 8 bits cuts the dot's skirts, which moves its centre of mass by hundredths of a pixel.
    assert np.linalg.norm(centre - patchmatch.pinhole(LENS).project(LENS.rays(at))) < 0.05
    assert np.linalg.norm(centre - at) > 0.5


def test_colours_keep_their_order(tmp_path: Path) -> None:
    red = np.zeros((160, 200, 3), np.uint8)
    red[..., 0] = 200
    written(tmp_path, LENS, ring(6), [red] * 6)
    stored = cv2.imread(str(tmp_path / "images" / image_name(0)))
    assert stored is not None
    assert stored[80, 100].tolist() == [0, 0, 200]


def test_every_photo_is_a_reference_with_partners_of_its_own(tmp_path: Path) -> None:
    poses = ring()
    written(tmp_path, LENS, poses, [np.zeros((160, 200, 3), np.uint8)] * len(poses))
    lines = (tmp_path / "stereo" / "patch-match.cfg").read_text().splitlines()
    references, partners = lines[::2], [line.split(", ") for line in lines[1::2]]
    assert references == [image_name(k) for k in range(len(poses))]
    sources = patchmatch.choose_sources(poses, VOLUME.centre, DepthSettings())
    assert partners == [[image_name(j) for j in own] for own in sources]
    usual = choose_pairs(poses, VOLUME.centre, DepthSettings())
    for k, own in enumerate(sources):
        assert k not in own
        assert len(set(own)) == len(own) >= 2
        assert {j for i, j in usual if i == k} <= set(own)


def test_a_photo_far_from_the_others_still_has_partners() -> None:
    poses = (*ring(8)[:4], look_at(np.array([0.0, -150, 20]), np.zeros(3), UP))
    assert not [j for i, j in choose_pairs(poses, VOLUME.centre, DepthSettings()) if i == 4]
    assert len(patchmatch.choose_sources(poses, VOLUME.centre, DepthSettings())[4]) == 2


def test_the_volume_lies_between_nearest_and_farthest_depth() -> None:
    poses = ring()
    low, high = patchmatch.depth_range(poses, VOLUME)
    depth = np.stack([p.apply(VOLUME.vertices)[:, 2] for p in poses])
    assert 0 < low < depth.min() < depth.max() < high < 1.1 * depth.max()
    near, _ = patchmatch.depth_range((look_at(np.array([0.0, 0, 21]), np.zeros(3), np.array([0.0, 1, 0])),), VOLUME)
    assert near > 0


def test_depth_files_of_colmaps_are_read(tmp_path: Path) -> None:
    depth = np.random.default_rng(0).uniform(90, 160, (4, 6)).astype(np.float32)
    depth[1, 2] = 0
    pycolmap.DepthMap.from_array(depth, 1.0, 200.0).write(tmp_path / "theirs.bin")
    assert np.array_equal(read_depth(tmp_path / "theirs.bin"), depth)
    # The documented form: width, height and channels as text, then float32 row by row.
    (tmp_path / "by_hand.bin").write_bytes(b"3&2&1&" + struct.pack("<6f", 1, 2, np.nan, 4, -5, 6))
    assert read_depth(tmp_path / "by_hand.bin").tolist() == [[1, 2, 0], [4, 0, 6]]


def test_the_child_asks_for_consistent_depth_in_the_volume_and_tells_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses = ring(6)
    plain = patchmatch.pinhole(LENS)
    asked: list[pycolmap.PatchMatchOptions] = []

    def colmap(workspace: Path, options: pycolmap.PatchMatchOptions) -> None:
        asked.append(options)
        assert (workspace / "sparse" / "images.bin").is_file()
        for kind in ("photometric", "geometric"):
            for k in range(len(poses)):
                depth = np.full((160, 200), 100.0 + k + 50 * (kind == "photometric"), np.float32)
                pycolmap.DepthMap.from_array(depth, 1.0, 300.0).write(depth_file(workspace, k, kind))
            time.sleep(1.2 * WATCH_SECONDS)

    monkeypatch.setattr(pycolmap, "patch_match_stereo", colmap)
    described: list[tuple[str, float]] = []
    arrays = {
        "images": np.zeros((6, 160, 200, 3), np.uint8),
        "pinhole": np.array([plain.focal_px, plain.cx, plain.cy]),
        "R": np.stack([p.R for p in poses]),
        "t": np.stack([p.t for p in poses]),
    }
    request = {
        "folder": str(tmp_path),
        "depth_mm": [90.0, 210.0],
        "sources": patchmatch.choose_sources(poses, VOLUME.centre, DepthSettings()),
    }
    found, facts = run(request, arrays, lambda step, share: described.append((step, share)))
    assert found["depth"][:, 3, 5].tolist() == [100, 101, 102, 103, 104, 105]
    assert facts == {"photos": 6}
    assert (asked[0].depth_min, asked[0].depth_max) == (90, 210)
    assert asked[0].geom_consistency
    assert asked[0].filter
    assert ("depth", 0.5) in described
    assert [share for _, share in described] == sorted(share for _, share in described)

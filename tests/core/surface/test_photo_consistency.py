"""Which photos are compared at a vertex, and where on its normal they agree best: on a textured plane with truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.photo_consistency import (
    HIGHLIGHT,
    LEAST_WITHOUT_HIGHLIGHTS,
    Photographs,
    choose_views,
    patch_scores,
)

LENS = Intrinsics.centred(240, 240, 480.0)
CAMERAS = 10
DISTANCE_MM, SPREAD_MM = 100.0, 40.0
TEXEL_MM = 0.1
SIDE_MM = 60.0
SAMPLE_MM = DISTANCE_MM / LENS.focal_px
UP = np.array([0.0, 0.0, 1.0])


def looking_down(x: float, y: float) -> Pose:
    """A camera at the common height that looks at the origin."""
    centre = np.array([x, y, DISTANCE_MM])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return Pose(R, -R @ centre)


@pytest.fixture(scope="module")
def plane() -> Photographs:
    """Photos of the plane z = 0, whose texture each camera sees through its exact homography."""
    rng = np.random.default_rng(0)
    texels = round(SIDE_MM / TEXEL_MM)
    texture = cv2.GaussianBlur(rng.normal(size=(texels, texels)).astype(np.float32), (0, 0), 4)
    texture = 110 + 25 * texture / texture.std()
    plane_from_texel = np.array([[TEXEL_MM, 0, -SIDE_MM / 2], [0, TEXEL_MM, -SIDE_MM / 2], [0, 0, 1]])
    angles = 2 * np.pi * np.arange(CAMERAS) / CAMERAS
    poses = tuple(looking_down(SPREAD_MM * np.cos(a), SPREAD_MM * np.sin(a)) for a in angles)
    greys = []
    for pose in poses:
        pixel_from_plane = LENS.matrix @ np.c_[pose.R[:, :2], pose.t]
        grey = cv2.warpPerspective(texture, pixel_from_plane @ plane_from_texel, (LENS.width, LENS.height))
        greys.append(np.asarray(np.clip(grey + rng.normal(0, 1, grey.shape), 0, 255), np.float32))
    return Photographs(greys, LENS, poses)


def grid(z: float) -> Mesh:
    """A square of the plane, at ``z``."""
    side = np.linspace(-8, 8, 17)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    n = len(side)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate(
        [np.stack([first, first + 1, first + n + 1], -1), np.stack([first, first + n + 1, first + n], -1)]
    )
    vertices = np.stack([x, y, np.full_like(x, z)], -1).astype(np.float32)
    normals = np.tile(UP, (len(x), 1)).astype(np.float32)
    return Mesh(vertices, triangles.astype(np.int32), normals, np.zeros(vertices.shape, np.uint8))


def chosen(plane: Photographs, z: float = 0.0, most: int = 6) -> NDArray[np.int64]:
    mesh = grid(z)
    return choose_views(mesh, np.arange(len(mesh.vertices)), plane, most, 0.25)


def peaks(plane: Photographs, z: float, half: int) -> Floats:
    """Offsets (n,) mm at which the patches of a plane at ``z`` agree best."""
    mesh, offsets = grid(z), np.linspace(-0.8, 0.8, 33)
    points = mesh.vertices.astype(float)
    normals = np.tile(UP, (len(points), 1))
    scores = patch_scores(points, normals, chosen(plane, z), plane, offsets, SAMPLE_MM, half)
    assert scores.shape == (len(points), len(offsets))
    assert scores.max() <= 1
    return np.asarray(offsets[scores.argmax(1)])


@pytest.mark.parametrize("half", [1, 2])
@pytest.mark.parametrize("z", [-0.3, 0.0, 0.4])
def test_photos_agree_best_on_the_true_surface(plane: Photographs, z: float, half: int) -> None:
    off = peaks(plane, z, half) + z
    assert abs(float(np.median(off))) < 0.03
    # Noise leaves something: nothing at all would be no measurement.
    assert 0.001 < np.abs(off).mean() < 0.12


def test_alike_patches_score_high_on_the_surface_and_low_off_it(plane: Photographs) -> None:
    points = grid(0.0).vertices.astype(float)
    normals = np.tile(UP, (len(points), 1))
    scores = patch_scores(points, normals, chosen(plane), plane, np.array([0.0, 3.0]), SAMPLE_MM, 2)
    assert 0.8 < np.median(scores[:, 0]) < 1
    assert np.median(scores[:, 1]) < 0.4


def test_a_patch_that_one_photo_sees_agrees_with_nothing(plane: Photographs) -> None:
    points = grid(0.0).vertices[:3].astype(float)
    views = np.array([[0, -1], [-1, -1], [0, 1]])
    scores = patch_scores(points, np.tile(UP, (3, 1)), views, plane, np.zeros(1), SAMPLE_MM, 2)[:, 0]
    assert scores[0] == pytest.approx(0, abs=1e-5)
    assert scores[1] == 0
    assert scores[2] > 0.5


def test_photos_that_show_a_highlight_are_left_out(plane: Photographs) -> None:
    lit = (2, 7)
    greys = list(plane.greys)
    for k in lit:
        at = plane.lens.project(plane.poses[k].apply(np.zeros(3)))
        spot = np.zeros_like(greys[k])
        cv2.circle(spot, (round(at[0]), round(at[1])), 12, 1.0, -1)
        greys[k] = np.clip(greys[k] + 60 * cv2.GaussianBlur(spot, (0, 0), 3), 0, 255).astype(np.float32)
    glossy = replace(plane, greys=greys)
    middle = np.linalg.norm(grid(0.0).vertices[:, :2], axis=1) < 1.5
    rim = np.linalg.norm(grid(0.0).vertices[:, :2], axis=1) > 7
    views = chosen(glossy)
    assert not np.isin(views[middle], lit).any()
    assert np.isin(views[rim], lit).any()
    assert (views[middle] >= 0).sum(1).min() >= LEAST_WITHOUT_HIGHLIGHTS


def test_a_bright_photo_is_no_highlight(plane: Photographs) -> None:
    greys = [np.asarray(g * (1.5 if k == 4 else 1.0), np.float32) for k, g in enumerate(plane.greys)]
    assert HIGHLIGHT < 1.5
    even = chosen(plane, most=CAMERAS)
    bright = chosen(replace(plane, greys=greys), most=CAMERAS)
    assert np.isin(4, even)
    share = float((bright == 4).any(1).mean()), float((even == 4).any(1).mean())
    assert share[0] == pytest.approx(share[1], abs=0.1)
    assert share[0] > 0.5


def test_views_come_packed_and_no_more_than_wanted(plane: Photographs) -> None:
    views = chosen(plane, most=5)
    assert views.shape[1] == 5
    known = views >= 0
    assert not (known[:, 1:] & ~known[:, :-1]).any()
    for row in views:
        named = row[row >= 0]
        assert len(set(named.tolist())) == len(named)


def test_more_vertices_than_one_look_up_takes(plane: Photographs) -> None:
    """A close-up shows tens of thousands in each photo."""
    side = np.linspace(-8, 8, 190)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    few = grid(0.0)
    vertices = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    normals = np.tile(UP, (len(x), 1))
    mesh = Mesh(vertices, few.triangles, normals.astype(np.float32), np.zeros(vertices.shape, np.uint8))
    assert len(x) > 32_767
    views = choose_views(mesh, np.arange(len(x)), plane, 6, 0.25)
    assert (views[:, :LEAST_WITHOUT_HIGHLIGHTS] >= 0).all()
    offsets = np.array([0.0, 3.0])
    scores = patch_scores(vertices.astype(float), normals, views, plane, offsets, SAMPLE_MM, 1)
    assert 0.6 < np.median(scores[:, 0]) < 1
    assert np.median(scores[:, 1]) < 0.5

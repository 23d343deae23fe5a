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
    CHECKING,
    HIGHLIGHT,
    LEAST_WITHOUT_HIGHLIGHTS,
    OWN_VARIANCE,
    Contrasts,
    Photographs,
    agreement,
    choose_views,
    frontal_views,
)
from specimap_core.surface.raycast import RayCaster

LENS = Intrinsics.centred(240, 240, 480.0)
CAMERAS = 10
DISTANCE_MM, SPREAD_MM = 100.0, 40.0
TEXEL_MM = 0.1
SIDE_MM = 60.0
SURROUNDINGS_PX = 3.0
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
        greys.append(np.clip(grey + rng.normal(0, 1, grey.shape), 0, 255).astype(np.uint8))
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
    return choose_views(RayCaster(mesh), np.arange(len(mesh.vertices)), plane, most, 0.25)


def scores(plane: Photographs, points: Floats, views: NDArray[np.int64], offsets: Floats) -> Floats:
    """Correlations (n, steps) of single pixels' contrasts, without surroundings to average over."""
    contrasts = Contrasts.of(plane, SURROUNDINGS_PX, 0.0)
    product, square = agreement(points, np.tile(UP, (len(points), 1)), views, contrasts, offsets)
    assert product.shape == square.shape == (len(points), len(offsets))
    return np.asarray(product / (square + OWN_VARIANCE))


@pytest.mark.parametrize("z", [-0.3, 0.0, 0.4])
def test_photos_agree_best_on_the_true_surface(plane: Photographs, z: float) -> None:
    mesh, offsets = grid(z), np.linspace(-0.8, 0.8, 33)
    contrasts = Contrasts.of(plane, SURROUNDINGS_PX, 0.0)
    points = mesh.vertices.astype(float)
    product, square = agreement(points, np.tile(UP, (len(points), 1)), chosen(plane, z), contrasts, offsets)
    # All together have one best offset; single pixels may have others that are as good.
    whole = product.sum(0) / square.sum(0)
    assert 0.6 < whole.max() < 1
    assert abs(offsets[whole.argmax()] + z) < 0.06
    alone = offsets[(product / (square + OWN_VARIANCE)).argmax(1)] + z
    assert 0.001 < np.median(np.abs(alone)) < 0.3


def test_contrasts_agree_on_the_surface_and_not_off_it(plane: Photographs) -> None:
    found = scores(plane, grid(0.0).vertices.astype(float), chosen(plane), np.array([-3.0, 0.0, 3.0]))
    off, on, other = np.median(found, axis=0)
    assert 0.6 < on < 1
    assert max(off, other) < 0.3


def test_a_place_that_one_photo_sees_agrees_with_nothing(plane: Photographs) -> None:
    points = grid(0.0).vertices.astype(float)
    offsets = np.array([0.0, 0.1])
    one, none, two = (
        scores(plane, points, np.tile(views, (len(points), 1)), offsets)[:, 0] for views in ([0, -1], [-1, -1], [0, 1])
    )
    assert one == pytest.approx(0, abs=1e-5)
    assert not none.any()
    assert np.median(two) > 0.5


def test_gain_offset_and_shading_are_gone_from_contrast(plane: Photographs) -> None:
    ramp = np.linspace(0.6, 1.0, LENS.width)
    shaded = [np.asarray(np.clip(g * ramp, 0, 255), np.uint8) for g in plane.greys]
    before = Contrasts.of(plane, SURROUNDINGS_PX, 0.0).sheet
    after = Contrasts.of(replace(plane, greys=shaded), SURROUNDINGS_PX, 0.0).sheet
    assert before.std() == pytest.approx(1, abs=0.3)
    assert float(np.corrcoef(before.ravel(), after.ravel())[0, 1]) > 0.97


def test_beyond_a_photo_lies_its_border_and_not_the_next_photo(plane: Photographs) -> None:
    greys = [np.full_like(plane.greys[0], 100), plane.greys[1]]
    contrasts = Contrasts.of(replace(plane, greys=greys, poses=plane.poses[:2]), SURROUNDINGS_PX, 0.0)
    beyond = np.array([[[LENS.width + 3.0, 50.0], [50.0, LENS.height + 40.0]]], np.float32)
    assert contrasts.at(np.zeros((1, 2), np.int64), beyond) == pytest.approx(0, abs=1e-4)
    inside = np.array([[[120.0, 90.0]]], np.float32)
    row, column = 90, LENS.width + 120
    assert contrasts.at(np.ones((1, 1), np.int64), inside)[0, 0] == pytest.approx(contrasts.sheet[row, column])


def test_photos_that_show_a_highlight_are_left_out(plane: Photographs) -> None:
    lit = (2, 7)
    greys = list(plane.greys)
    for k in lit:
        at = plane.lens.project(plane.poses[k].apply(np.zeros(3)))
        spot = np.zeros(greys[k].shape, np.float32)
        cv2.circle(spot, (round(at[0]), round(at[1])), 12, 1.0, -1)
        greys[k] = np.clip(greys[k] + 60 * cv2.GaussianBlur(spot, (0, 0), 3), 0, 255).astype(np.uint8)
    glossy = replace(plane, greys=greys)
    middle = np.linalg.norm(grid(0.0).vertices[:, :2], axis=1) < 1.5
    rim = np.linalg.norm(grid(0.0).vertices[:, :2], axis=1) > 7
    views = chosen(glossy)
    assert not np.isin(views[middle], lit).any()
    assert np.isin(views[rim], lit).any()
    assert (views[middle] >= 0).sum(1).min() >= LEAST_WITHOUT_HIGHLIGHTS


def test_a_bright_photo_is_no_highlight(plane: Photographs) -> None:
    greys = [np.clip(g * (1.5 if k == 4 else 1.0), 0, 255).astype(np.uint8) for k, g in enumerate(plane.greys)]
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


def test_some_of_the_more_oblique_photos_are_left_for_checking(plane: Photographs) -> None:
    caster = RayCaster(grid(0.0))
    vertices = np.arange(len(caster.mesh.vertices))
    seen = frontal_views(caster, vertices, plane, CAMERAS, 0.25)
    assert (np.sort(seen, axis=1) == np.arange(CAMERAS)).all()
    compared = choose_views(caster, vertices, plane, CAMERAS, 0.25)
    left = seen[:, CHECKING]
    assert left.shape[1] == 1
    for vertex in vertices:
        named = compared[vertex][compared[vertex] >= 0].tolist()
        assert named == np.delete(seen[vertex], CHECKING).tolist()
        assert not set(named) & set(left[vertex].tolist())


def test_more_vertices_than_one_look_up_takes(plane: Photographs) -> None:
    """A close-up shows tens of thousands in each photo."""
    side = np.linspace(-8, 8, 190)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    few = grid(0.0)
    vertices = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    normals = np.tile(UP, (len(x), 1))
    mesh = Mesh(vertices, few.triangles, normals.astype(np.float32), np.zeros(vertices.shape, np.uint8))
    assert len(x) > 32_767
    views = choose_views(RayCaster(mesh), np.arange(len(x)), plane, 6, 0.25)
    assert (views[:, :LEAST_WITHOUT_HIGHLIGHTS] >= 0).all()
    found = scores(plane, vertices.astype(float), views, np.array([0.0, 3.0]))
    assert 0.6 < np.median(found[:, 0]) < 1
    assert np.median(found[:, 1]) < 0.3

"""Cameras, transforms and pixel conventions against their definitions."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specimap_core.geometry.cameras import Intrinsics, Pose, View, fit_similarity, look_at, rotation_from_vector, skew
from specimap_core.geometry.colmap_cameras import colmap_from_opencv, opencv_from_colmap
from tests.support.scenes import rotation_deg

LENS = Intrinsics(640, 480, 700.0, 322.5, 236.25, 0.08, -0.03)


def random_pose(seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    return Pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3) * 20)


def test_projection_is_opencvs() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-40, 40, (50, 3)) + np.array([0, 0, 200])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)
    assert np.allclose(LENS.project(points), expected[:, 0], atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(x=st.floats(0, 639), y=st.floats(0, 479), k1=st.floats(-0.1, 0.1), k2=st.floats(-0.05, 0.05))
def test_rays_undo_projection(x: float, y: float, k1: float, k2: float) -> None:
    lens = Intrinsics(640, 480, 900.0, 319.5, 239.5, k1, k2)
    pixel = np.array([x, y])
    assert np.allclose(lens.project(lens.rays(pixel) * 150.0), pixel, atol=1e-4)


def test_rotation_vectors_are_rodrigues() -> None:
    rng = np.random.default_rng(1)
    for rvec in [*rng.normal(size=(20, 3)), np.zeros(3), np.full(3, 1e-10)]:
        assert np.allclose(rotation_from_vector(rvec), cv2.Rodrigues(rvec)[0], atol=1e-9)
    a, b = rng.normal(size=(2, 3))
    assert np.allclose(skew(a) @ b, np.cross(a, b))


def test_pose_composition_inverse_and_centre() -> None:
    a, b = random_pose(1), random_pose(2)
    points = np.random.default_rng(3).normal(size=(7, 3))
    assert np.allclose((a @ b).apply(points), a.apply(b.apply(points)))
    assert np.allclose(a.inverse().apply(a.apply(points)), points)
    assert np.allclose(a.apply(a.centre), 0)
    assert np.allclose(a.matrix[:3, :3], a.R)


def test_look_at_sees_the_target_in_the_middle_and_up_above() -> None:
    pose = look_at(np.array([100.0, 50, 120]), np.array([1.0, 2, 3]), np.array([0.0, 0, 1]))
    target = pose.apply(np.array([1.0, 2, 3]))
    assert np.allclose(target[:2], 0)
    assert target[2] > 0
    assert pose.apply(np.array([1.0, 2, 13]))[1] < 0  # y runs down
    assert np.isclose(np.linalg.det(pose.R), 1)


def test_view_rays_pass_through_what_they_see() -> None:
    view = View(LENS, look_at(np.array([60.0, -80, 140]), np.zeros(3), np.array([0.0, 0, 1])))
    points = np.random.default_rng(4).uniform(-15, 15, (30, 3))
    rays = view.world_rays(view.project(points))
    assert np.allclose(np.linalg.norm(rays, axis=1), 1)
    reach = points - view.cam_from_world.centre
    assert np.linalg.norm(np.cross(rays, reach), axis=1).max() < 1e-4


@pytest.mark.parametrize("scale", [1.0, 0.37, 12.0])
def test_similarity_is_found_again(scale: float) -> None:
    rng = np.random.default_rng(5)
    source = rng.normal(size=(12, 3))
    truth = random_pose(6)
    target = scale * source @ truth.R.T + truth.t
    found, R, t = fit_similarity(source, target, with_scale=True)
    assert np.isclose(found, scale)
    assert rotation_deg(Pose(R, t), truth) < 1e-5
    assert np.allclose(t, truth.t)


def test_similarity_of_a_mirrored_cloud_stays_a_rotation() -> None:
    source = np.random.default_rng(7).normal(size=(12, 3))
    _, R, _ = fit_similarity(source, source * [1, 1, -1])
    assert np.isclose(np.linalg.det(R), 1)


def test_colmaps_half_pixel_is_there_and_back() -> None:
    first = np.array([0.0, 0.0])
    assert np.allclose(colmap_from_opencv(first), [0.5, 0.5])
    assert np.allclose(opencv_from_colmap(colmap_from_opencv(first)), first)


def test_a_resized_lens_sees_the_same_rays() -> None:
    half = LENS.scaled(0.5)
    # The middle of the pixels (0, 0), (1, 0), (0, 1), (1, 1) is the centre of the first pixel at half size.
    assert np.allclose(half.rays(np.array([0.0, 0.0])), LENS.rays(np.array([0.5, 0.5])))
    assert (half.width, half.height) == (320, 240)

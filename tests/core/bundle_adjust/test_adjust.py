"""Stage 2 against truth: millimetres, the marker frame, and a covariance that means what it says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted, AdjustSettings, Form, adjust
from specimap_core.bundle_adjust.solver import GROWTH_PX, PHOTO_GROWTH_PX, MarkerScene
from specimap_core.errors import MarkerGeometryError
from specimap_core.fiducials.layout import edge_lengths, marker_frame, rigid_square
from specimap_core.fiducials.observations import Observations, corner_shifts
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Pose, fit_similarity, rotation_from_vector
from tests.support.scenes import EDGE_MM, marker_scene

IDS = (3, 5, 8, 11)


def strange_frame(scene: MarkerScene, scale: float = 0.31) -> tuple[Pose, ...]:
    """The true poses as a backend would give them: in another frame and another unit."""
    frame = Pose(rotation_from_vector(np.array([0.3, -1.1, 0.7])), np.array([40.0, -9, 77]))
    return tuple(Pose((p @ frame).R, scale * (p @ frame).t) for p in scene.poses)


def grown(seen: Observations, rng: np.random.Generator) -> Observations:
    """The corners as photos show them in which black grows a little at edges, in all alike and in each on its own."""
    each = rng.normal(0, GROWTH_PX) + rng.normal(0, PHOTO_GROWTH_PX, seen.photo.max() + 1)
    return replace(seen, corners_px=seen.corners_px + each[seen.photo, None, None] * corner_shifts(seen.corners_px))


def adjusted(seed: int, form: Form = "rigid", noise_px: float = 0.1) -> tuple[MarkerScene, Adjusted]:
    truth, seen = marker_scene(seed=seed, noise_px=noise_px)
    seen = grown(seen, np.random.default_rng(seed))
    return truth, adjust(truth.lens, strange_frame(truth), seen, IDS, AdjustSettings(form, EDGE_MM))


def after_fit(found: Floats, truth: Floats) -> Floats:
    """Differences (N, 3) after a rigid fit."""
    a, b = found.reshape(-1, 3), truth.reshape(-1, 3)
    _, R, t = fit_similarity(a, b)
    return np.asarray(a @ R.T + t - b)


@pytest.mark.parametrize("form", ["rigid", "free"])
def test_corners_come_out_in_millimetres(form: Form) -> None:
    truth, found = adjusted(1, form)
    errors = np.linalg.norm(after_fit(found.corners, truth.corners), axis=1)
    assert 0.001 < np.median(errors) < 0.05
    size, _, _ = fit_similarity(truth.corners.reshape(-1, 3), found.corners.reshape(-1, 3), with_scale=True)
    assert 1e-6 < abs(size - 1) < 0.003
    assert np.isclose(edge_lengths(found.corners).mean(), EDGE_MM, rtol=1e-6)
    assert 0.05 < found.rms_after_px < 0.25
    assert found.marker_ids == IDS


def test_the_rigid_form_is_the_more_accurate() -> None:
    errors: dict[Form, list[float]] = {"rigid": [], "free": []}
    for seed in range(6):
        for form, collected in errors.items():
            truth, found = adjusted(seed, form)
            collected.append(float(np.linalg.norm(after_fit(found.corners, truth.corners), axis=1).mean()))
    assert np.mean(errors["rigid"]) < np.mean(errors["free"])


def test_the_answer_is_in_the_marker_frame() -> None:
    truth, found = adjusted(2)
    assert np.allclose(found.corners.mean((0, 1)), 0, atol=1e-9)
    first = found.corners[0].mean(0)
    assert first[0] > 10
    assert abs(first[1]) < 1e-9  # x runs toward the marker of the lowest id
    assert all(p.centre[2] > 50 for p in found.poses)  # z toward the cameras
    for pose, true in zip(found.poses, truth.poses, strict=True):
        assert abs(np.linalg.norm(pose.centre) - np.linalg.norm(true.centre - truth.corners.mean((0, 1)))) < 1.0


def test_the_scale_turns_the_backends_unit_into_millimetres() -> None:
    truth, seen = marker_scene(seed=3)
    found = adjust(truth.lens, strange_frame(truth, 0.31), seen, IDS, AdjustSettings(edge_mm=EDGE_MM))
    assert found.scale * 0.31 == pytest.approx(1, rel=0.005)


@pytest.mark.parametrize("form", ["rigid", "free"])
def test_the_covariance_is_that_of_the_errors(form: Form) -> None:
    """Errors of repeated noise, in the layout's own frame, scatter as stated (as one standard deviation)."""
    truth, _ = marker_scene(seed=4)
    ratios = []
    for seed in range(12):
        _, exact = marker_scene(seed=4, noise_px=0.0)
        noise = np.random.default_rng(100 + seed).normal(0, 0.1, exact.corners_px.shape)
        seen = replace(exact, corners_px=exact.corners_px + noise, sigma_px=np.full(len(exact.photo), 0.1))
        found = adjust(truth.lens, truth.poses, seen, IDS, AdjustSettings(form, EDGE_MM))
        errors = np.linalg.norm(after_fit(found.corners, truth.corners), axis=1)
        ratios.append(errors / found.sigma_corner_mm.ravel())
    assert 0.6 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.6


def test_photos_without_a_marker_move_with_the_rest() -> None:
    truth, seen = marker_scene(seed=5)
    blind = seen.of(seen.photo != 6)
    found = adjust(truth.lens, strange_frame(truth), blind, IDS, AdjustSettings(edge_mm=EDGE_MM))
    frame = marker_frame(truth.corners, np.stack([p.centre for p in truth.poses]))
    assert np.linalg.norm(found.poses[6].centre - frame.apply(truth.poses[6].centre)) < 1.0


def test_a_marker_that_one_photo_alone_shows_is_left_out() -> None:
    truth, seen = marker_scene(seed=6)
    seen = seen.of((seen.marker != 2) | (seen.photo == 0))
    found = adjust(truth.lens, truth.poses, seen, IDS, AdjustSettings(edge_mm=EDGE_MM))
    assert found.marker_ids == (3, 5, 11)


def test_nothing_shared_is_refused() -> None:
    truth, seen = marker_scene(seed=7)
    alone = seen.of(seen.marker == seen.photo)
    with pytest.raises(MarkerGeometryError):
        adjust(truth.lens, truth.poses, alone, IDS, AdjustSettings(edge_mm=EDGE_MM))


def test_triangulation_without_noise_is_exact() -> None:
    truth, seen = marker_scene(seed=8, noise_px=0.0)
    assert np.allclose(triangulate(truth.lens, truth.poses, seen, 4), truth.corners, atol=1e-8)
    once: Observations = seen.of(seen.photo == 0)
    assert np.isnan(triangulate(truth.lens, truth.poses, once, 4)).all()


def test_one_marker_makes_a_frame() -> None:
    truth, seen = marker_scene(markers=1, seed=9)
    found = adjust(truth.lens, truth.poses, seen, (7,), AdjustSettings(edge_mm=EDGE_MM))
    assert np.allclose(found.corners.mean((0, 1)), 0, atol=1e-9)
    top = found.corners[0, 1] - found.corners[0, 0]
    assert top[0] > 6
    assert abs(top[1]) < 1e-6  # its top edge gives x
    square = rigid_square(found.corners[0], EDGE_MM)
    assert np.allclose(square.t, 0, atol=1e-9)

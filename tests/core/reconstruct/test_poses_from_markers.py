"""Cameras from marker corners alone, against scenes whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import MarkerScene, rms_px, solve
from specimap_core.errors import MarkerGeometryError
from specimap_core.fiducials.observations import Observations, corners_of, square_corners
from specimap_core.geometry.cameras import Intrinsics, Pose, fit_similarity
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.false_markers import misread_ids, start_without_markers, without_markers
from specimap_core.reconstruct.poses_from_markers import MarkerSolution, solve_from_markers
from specimap_core.reconstruct.square_poses import two_poses
from tests.support.scenes import EDGE_MM, marker_scene, rotation_deg

SIZE = (640, 480)


def solved(seen: Observations, ids: tuple[int, ...], focal_px: float | None = None) -> MarkerSolution:
    return solve_from_markers(seen, ids, SIZE, edge_mm=EDGE_MM, focal_px=focal_px)


def corner_errors(scene: MarkerScene, truth: Floats) -> Floats:
    """Distances of corners after a rigid fit."""
    found = scene.corners.reshape(-1, 3)
    _, R, t = fit_similarity(found, truth.reshape(-1, 3))
    return np.asarray(np.linalg.norm(found @ R.T + t - truth.reshape(-1, 3), axis=1))


def pose_errors(solution: MarkerSolution, truth: MarkerScene) -> Floats:
    """Angles, in degrees, between found and true poses in the frame of the true corners."""
    index = list(solution.photos)
    _, R, t = fit_similarity(
        truth.corners[list(solution.markers)].reshape(-1, 3), solution.scene.corners.reshape(-1, 3)
    )
    back = Pose(R, t)
    return np.array([rotation_deg(p @ back, truth.poses[k]) for k, p in zip(index, solution.scene.poses, strict=True)])


@pytest.mark.parametrize("markers", [1, 2, 4, 9])
def test_all_photos_are_posed_without_calibration(markers: int) -> None:
    truth, seen = marker_scene(markers=markers, seed=markers)
    solution = solved(seen, tuple(range(markers)))
    assert solution.photos == tuple(range(10))
    assert not solution.foreign
    assert 0.02 < solution.info.rms_after_px < 0.3
    if markers > 1:
        assert abs(solution.scene.lens.focal_px / truth.lens.focal_px - 1) < 0.02
        assert 1e-4 < corner_errors(solution.scene, truth.corners).max() < 0.1
        assert pose_errors(solution, truth).max() < 1.0


@pytest.mark.parametrize("focal", [500.0, 820.0, 1400.0])
def test_the_focal_length_is_found_from_no_start(focal: float) -> None:
    truth, seen = marker_scene(lens=Intrinsics.centred(*SIZE, focal), seed=3)
    found = solved(seen, (0, 1, 2, 3)).scene.lens.focal_px
    assert 1e-6 < abs(found / truth.lens.focal_px - 1) < 0.02


def test_lens_distortion_is_found() -> None:
    lens = Intrinsics.centred(*SIZE, 820.0, k1=0.08)
    truth, seen = marker_scene(photos=20, lens=lens, noise_px=0.05, seed=5)
    found = solved(seen, (0, 1, 2, 3)).scene
    assert 0.04 < found.lens.k1 < 0.12
    assert corner_errors(found, truth.corners).max() < 0.06


def test_a_wrong_exif_focal_length_does_no_harm() -> None:
    truth, seen = marker_scene(seed=4)
    found = solved(seen, (0, 1, 2, 3), focal_px=1.1 * truth.lens.focal_px)
    assert abs(found.scene.lens.focal_px / truth.lens.focal_px - 1) < 0.02


def test_cards_need_not_be_coplanar() -> None:
    truth, seen = marker_scene(tilt_deg=8, seed=6)
    solution = solved(seen, (0, 1, 2, 3))
    assert 1e-4 < corner_errors(solution.scene, truth.corners).max() < 0.1


def test_a_photo_with_one_marker_is_not_flipped() -> None:
    truth, seen = marker_scene(photos=12, seed=7)
    for photo in range(3):  # these show one marker each
        seen = seen.of((seen.photo != photo) | (seen.marker == photo))
    solution = solved(seen, (0, 1, 2, 3))
    errors = pose_errors(solution, truth)
    sure = np.array([p not in solution.ambiguous for p in solution.photos])
    assert errors[sure].max() < 3
    assert sure.sum() >= 9


def test_the_two_poses_of_a_square_hold_the_true_one() -> None:
    truth, seen = marker_scene(noise_px=0.0, seed=8)
    for k in range(12):
        options = two_poses(seen.corners_px[k : k + 1], truth.lens, EDGE_MM)[0]
        assert len(options) == 2
        assert truth.squares is not None
        true = truth.poses[seen.photo[k]] @ truth.squares[seen.marker[k]]
        assert min(rotation_deg(pose, true) for pose, _ in options) < 0.1
        assert options[0][1] <= options[1][1]


def moved(seen: Observations, other: Observations, photos: set[int]) -> Observations:
    """These photos show another scene."""
    of_other = np.isin(seen.photo, list(photos))
    return replace(seen, corners_px=np.where(of_other[:, None, None], other.corners_px, seen.corners_px))


def test_a_foreign_photo_is_told_from_the_rest() -> None:
    truth, seen = marker_scene(seed=9)
    _, other = marker_scene(seed=10)
    solution = solved(moved(seen, other, {4}), (0, 1, 2, 3))
    assert set(solution.foreign) == {4}
    assert solution.foreign[4] > 5
    assert corner_errors(solution.scene, truth.corners).max() < 0.1


def test_two_scenes_are_told_apart() -> None:
    _, seen = marker_scene(photos=12, seed=11)
    _, other = marker_scene(photos=12, seed=12)
    solution = solved(moved(seen, other, set(range(7, 12))), (0, 1, 2, 3))
    assert set(solution.foreign) == set(range(7, 12))
    assert solution.info.rms_after_px < 0.4


def test_photos_that_share_no_marker_are_said() -> None:
    _, seen = marker_scene(markers=4, seed=13)
    keep = np.where(seen.photo < 7, seen.marker < 2, seen.marker >= 2)
    solution = solved(seen.of(keep), (0, 1, 2, 3))
    assert solution.unconnected == (7, 8, 9)
    assert solution.markers == (0, 1)


def test_one_wrong_marker_reading_is_left_out() -> None:
    truth, seen = marker_scene(seed=14)
    corners = seen.corners_px.copy()
    corners[5] += 40.0
    solution = solved(replace(seen, corners_px=corners), (0, 1, 2, 3))
    assert len(solution.seen.photo) == len(seen.photo) - 1
    assert corner_errors(solution.scene, truth.corners).max() < 0.1


def with_readings(seen: Observations, false: list[tuple[int, int, tuple[float, float]]]) -> Observations:
    """Squares of 20 px besides, (photo, marker, place)."""
    square = np.array([[0.0, 0], [20, 0], [20, 20], [0, 20]])
    return Observations(
        np.append(seen.photo, [p for p, _, _ in false]),
        np.append(seen.marker, [m for _, m, _ in false]),
        np.concatenate([seen.corners_px, *(square[None] + at for _, _, at in false)]),
        np.append(seen.sigma_px, [0.1] * len(false)),
    )


def test_ids_that_no_two_photos_show_at_one_place_are_false_readings() -> None:
    """Each shows in two photos or three, as ids of texture do in dictionaries of few bits; the rest stays as it was."""
    truth, seen = marker_scene(photos=10, markers=6, noise_px=0.1)
    places = [(40.0, 30.0), (560.0, 60.0), (330.0, 420.0)]
    false = [(3 * k % 10, 6, places[k]) for k in range(3)] + [(1, 7, places[1]), (6, 7, places[0])]
    ids = (0, 1, 2, 3, 4, 5, 104, 590)
    corners = CornersInPhotos(with_readings(seen, false), ids)
    solution = solved(corners.seen, ids)
    assert misread_ids(corners, solution) == {104, 590}
    left = without_markers(corners, {104, 590})
    assert left.marker_ids == ids[:6]
    assert np.array_equal(left.seen.corners_px, seen.corners_px)
    assert np.array_equal(left.seen.marker, seen.marker)
    again = solve_from_markers(
        left.seen, left.marker_ids, SIZE, edge_mm=EDGE_MM, start=start_without_markers(solution, {104, 590})
    )
    assert again.markers == ids[:6]
    assert 0 < corner_errors(again.scene, truth.corners).max() < 0.05


def test_a_marker_that_was_moved_is_no_false_reading() -> None:
    """It shows at one place in five photos, at another in five: that contradiction is for the gates to tell."""
    _, seen = marker_scene(photos=10, markers=6, noise_px=0.1)
    moved = seen.corners_px.copy()
    moved[(seen.marker == 2) & (seen.photo >= 5)] += 40.0
    corners = CornersInPhotos(replace(seen, corners_px=moved), tuple(range(6)))
    assert not misread_ids(corners, solved(corners.seen, corners.marker_ids))


def test_markers_of_photos_that_are_not_posed_are_no_false_readings() -> None:
    """Photos of another scene must be told as that; some wait for features."""
    _, seen = marker_scene(photos=10, markers=6, noise_px=0.1)
    seen = seen.of((seen.photo < 8) == (seen.marker < 4))
    corners = CornersInPhotos(seen, tuple(range(6)))
    solution = solved(corners.seen, corners.marker_ids)
    assert not {8, 9} & set(solution.photos)
    assert not misread_ids(corners, solution)


def test_an_earlier_solution_leads_to_the_same_answer() -> None:
    """Corners that moved a little, and a photo and a marker that the earlier solution does not know."""
    truth, seen = marker_scene(seed=4)
    earlier = solved(seen.of((seen.photo != 6) & (seen.marker != 2)), (0, 1, 2, 3))
    assert 6 not in earlier.photos
    assert earlier.markers == (0, 1, 3)
    shift = np.random.default_rng(5).normal(0, 0.1, seen.corners_px.shape)
    later = replace(seen, corners_px=seen.corners_px + shift)
    anew = solved(later, (0, 1, 2, 3))
    onward = solve_from_markers(later, (0, 1, 2, 3), SIZE, edge_mm=EDGE_MM, start=earlier)
    assert onward.photos == anew.photos == tuple(range(10))
    assert onward.markers == anew.markers == (0, 1, 2, 3)
    assert not onward.foreign
    assert np.isclose(onward.info.cost, anew.info.cost, rtol=1e-4)
    assert np.isclose(onward.scene.lens.focal_px, anew.scene.lens.focal_px, rtol=1e-4)
    assert 1e-4 < corner_errors(onward.scene, truth.corners).max() < 0.1
    assert corner_errors(onward.scene, anew.scene.corners).max() < 1e-3


def test_nonsense_is_refused() -> None:
    _, seen = marker_scene(seed=15)
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 400, (len(seen.photo), 1, 2)) + rng.uniform(-60, 60, seen.corners_px.shape)
    with pytest.raises(MarkerGeometryError) as refused:
        solved(replace(seen, corners_px=corners), (0, 1, 2, 3))
    assert refused.value.advice


# ---- the least squares itself -------------------------------------------------------------------------


@pytest.mark.parametrize("rigid", [True, False])
def test_the_derivatives_are_those_of_the_residuals(rigid: bool) -> None:
    """A quadratic minimum: from a disturbed start the solver comes to the same place as from the truth."""
    truth, seen = marker_scene(noise_px=0.1, seed=16)
    rng = np.random.default_rng(1)
    start = MarkerScene(
        truth.lens,
        tuple(Pose(p.R, p.t + rng.normal(0, 0.4, 3)) for p in truth.poses),
        truth.corners,
        truth.squares if rigid else None,
    )
    near, _ = solve(replace(truth, squares=start.squares), seen, edge_mm=EDGE_MM, refine_lens=False, robust=False)
    far, info = solve(start, seen, edge_mm=EDGE_MM, refine_lens=False, robust=False)
    assert np.isclose(rms_px(near.residuals(seen)), rms_px(far.residuals(seen)), rtol=1e-4)
    assert info.rms_after_px < info.rms_before_px / 5
    # Noise of sd s per coordinate leaves an RMS a little below s * sqrt(2).
    assert 0.09 < info.rms_after_px < 0.15


def test_the_robust_loss_withstands_outliers() -> None:
    truth, seen = marker_scene(noise_px=0.1, seed=17)
    corners = seen.corners_px.copy()
    corners[::17] += 5.0
    spoilt = replace(seen, corners_px=corners)
    robust, info = solve(truth, spoilt, edge_mm=EDGE_MM, refine_lens=False)
    plain, _ = solve(truth, spoilt, edge_mm=EDGE_MM, refine_lens=False, robust=False)
    assert corner_errors(robust, truth.corners).max() < 0.5 * corner_errors(plain, truth.corners).max()
    assert info.weights[::17].max() < 0.6


def test_the_lens_is_held_where_it_is_not_refined() -> None:
    truth, seen = marker_scene(seed=18)
    held, _ = solve(truth, seen, edge_mm=EDGE_MM, refine_lens=False)
    assert held.lens == truth.lens


def test_a_square_is_upright_and_of_its_edge() -> None:
    corners = square_corners(EDGE_MM)
    assert np.allclose(np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1), EDGE_MM)
    assert corners[0, 0] < 0 < corners[0, 1]  # top-left first
    assert corners_of((Pose(np.eye(3), np.array([1.0, 2, 3])),), EDGE_MM).mean((0, 1)) == pytest.approx([1, 2, 3])

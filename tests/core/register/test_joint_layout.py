"""The markers' layout by photos and cube together: truer than by the photos, with a covariance that says how true."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted, AdjustSettings, adjust
from specimap_core.bundle_adjust.solver import GROWTH_PX, PHOTO_GROWTH_PX
from specimap_core.fiducials.observations import corner_shifts
from specimap_core.geometry.cameras import Intrinsics, View, fit_similarity, look_at
from specimap_core.register.camera_models import FRAME, radial_at_corner
from specimap_core.register.corners import CornersInCube
from specimap_core.register.joint_layout import JointLayout, join_cube
from tests.support.scenes import EDGE_MM, marker_scene

IDS = (3, 5, 8, 11)
ROWS, COLS = 512, 640
CUBE_PX = 0.015
SEEDS = range(8)


@dataclass(frozen=True)
class Joined:
    """A layout by the photos and by both; the true corners (Q, 4, 3) mm, and the cube's true ``view``."""

    photos: Adjusted
    joint: JointLayout
    truth: Floats
    view: View


def cube_above(k1: float) -> View:
    lens = Intrinsics.centred(COLS, ROWS, 3000.0, k1)
    return View(lens, look_at(np.array([12.0, -9.0, 400.0]), np.zeros(3), np.array([0.1, 1.0, 0.0])))


def joined(seed: int, *, k1: float = 0.0, moved_px: float = 0.0, ids: tuple[int, ...] = IDS) -> Joined:
    """Photos in which black grows at edges by a few hundredths of a pixel, and a cube whose corners are sharp."""
    rng = np.random.default_rng(seed)
    truth, seen = marker_scene(photos=20, seed=seed, noise_px=0.06, tilt_deg=1.0)
    each = rng.normal(0, GROWTH_PX) + rng.normal(0, PHOTO_GROWTH_PX, len(truth.poses))
    seen = replace(seen, corners_px=seen.corners_px + each[seen.photo, None, None] * corner_shifts(seen.corners_px))
    photos = adjust(truth.lens, truth.poses, seen, IDS, AdjustSettings("rigid", EDGE_MM))
    view = cube_above(k1)
    at = [IDS.index(i) for i in ids]
    pixels = view.project(truth.corners[at]) + rng.normal(0, CUBE_PX, (len(at), 4, 2))
    pixels[-1] += [moved_px, -moved_px / 2]
    columns = (12 * np.array(at)[:, None] + np.arange(12)).ravel()
    corners = CornersInCube(
        ids, photos.corners[at], pixels, np.full(len(at), CUBE_PX), photos.covariance[np.ix_(columns, columns)]
    )
    return Joined(photos, join_cube(corners, photos, ROWS, COLS), truth.corners, view)


@cache
def many() -> list[Joined]:
    return [joined(seed) for seed in SEEDS]


def after_fit(found: Floats, truth: Floats) -> Floats:
    """Differences (N, 3) mm after a rigid fit."""
    a, b = found.reshape(-1, 3), truth.reshape(-1, 3)
    _, R, t = fit_similarity(a, b)
    return np.asarray(a @ R.T + t - b)


def off_mm(found: Floats, truth: Floats) -> float:
    return float(np.median(np.linalg.norm(after_fit(found, truth), axis=1)))


def scale_of(found: Floats, truth: Floats) -> float:
    return fit_similarity(truth.reshape(-1, 3), found.reshape(-1, 3), with_scale=True)[0] - 1


def test_the_cube_corrects_the_layout_and_its_scale() -> None:
    before = [off_mm(j.photos.corners, j.truth) for j in many()]
    after = [off_mm(j.joint.adjusted.corners, j.truth) for j in many()]
    assert 0.0005 < np.median(after) < np.median(before) / 2
    assert max(after) < 0.012
    scales = np.array([[scale_of(c, j.truth) for c in (j.photos.corners, j.joint.adjusted.corners)] for j in many()])
    by_photos, by_both = np.sqrt((scales**2).mean(0))
    assert 1e-6 < by_both < 3e-4
    assert by_both < by_photos / 2
    # What the photos placed follows.
    for j in many():
        assert j.joint.scale == pytest.approx(1 + scale_of(j.joint.adjusted.corners, j.photos.corners), abs=1e-9)
        ratio = j.joint.adjusted.poses[0].t / j.photos.poses[0].t
        assert ratio == pytest.approx(j.joint.scale)


def test_the_covariance_is_that_of_the_errors() -> None:
    normalised = []
    for j in many():
        errors = after_fit(j.joint.adjusted.corners, j.truth)
        stated = j.joint.adjusted.sigma_corner_mm.ravel()
        normalised.append(np.linalg.norm(errors, axis=1) / stated)
        assert np.linalg.eigvalsh(j.joint.adjusted.covariance).min() > -1e-9
        assert (stated < j.photos.sigma_corner_mm.ravel()).all()
    # Root mean square of normalised errors: 1, as well as eight layouts of few independent numbers tell.
    assert 0.5 < np.sqrt((np.concatenate(normalised) ** 2).mean()) < 1.6


def test_the_lens_of_the_cube_shows_in_its_corners() -> None:
    strong = 0.5
    off = []
    for seed in range(4):
        j = joined(seed, k1=strong)
        lens = j.joint.by_corners[FRAME].camera.view.intrinsics
        off.append(radial_at_corner(lens) - radial_at_corner(j.view.intrinsics))
        assert off_mm(j.joint.adjusted.corners, j.truth) < 0.02
    assert radial_at_corner(cube_above(strong).intrinsics) > 0.008
    # The prior draws it a little toward none.
    assert 1e-5 < np.sqrt(np.mean(np.square(off))) < 0.0025


@pytest.mark.parametrize("moved_px", [2.0, 10.0, 60.0])
def test_a_marker_that_moved_is_named_and_left_out(moved_px: float) -> None:
    j = joined(int(moved_px), moved_px=moved_px)
    assert list(j.joint.moved_mm) == [IDS[-1]]
    span = 400 / 3000.0
    assert j.joint.moved_mm[IDS[-1]] == pytest.approx(np.hypot(moved_px, moved_px / 2) * span, rel=0.1, abs=0.05)
    assert j.joint.seen.marker_ids == IDS[:-1]
    assert off_mm(j.joint.adjusted.corners, j.truth) < 0.03
    (warning,) = j.joint.warnings()
    assert warning.code == "marker_moved"
    assert f"Marker {IDS[-1]} " in warning.message


def test_sound_cubes_have_no_moved_marker() -> None:
    assert all(j.joint.moved_mm == {} and j.joint.warnings() == [] for j in many())


def test_two_markers_leave_the_layout_of_the_photos() -> None:
    j = joined(0, ids=IDS[:2])
    assert j.joint.adjusted is j.photos
    assert j.joint.scale == 1.0
    assert j.joint.by_corners


def test_corners_without_covariance_leave_the_layout_of_the_photos() -> None:
    photos, seen = many()[0].photos, many()[0].joint.seen
    alone = join_cube(replace(seen, covariance=None), photos, ROWS, COLS)
    assert alone.adjusted is photos
    assert alone.scale == 1.0

"""Cameras that hang lower over a wide layout than the box is high in which a surface is looked for."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from specimap_core.arrays import Bytes, Floats
from specimap_core.errors import DepthNotFoundError
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at
from specimap_core.reconstruct.dense import multi_view
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.stereo import viewing_angles_deg
from specimap_core.reconstruct.dense.volume import Volume, lattice_over, volume_over
from specimap_core.surface.settings import SurfaceSettings
from specimap_validation.phantom import Phantom, PhantomSettings
from tests.support.true_depth import true_depth

pytestmark = pytest.mark.slow

UP = np.array([0.0, 0.0, 1.0])


def low_views(photos: int = 24) -> list[View]:
    """Wide-angle cameras 34 to 46 mm above the table, at the rim of a layout 110 mm wide, looking across it."""
    rng = np.random.default_rng(4)
    lens = Intrinsics.centred(448, 448, 380.0)
    views = []
    for k in range(photos):
        angle = 2 * np.pi * k / photos
        eye = np.array([62 * np.cos(angle), 62 * np.sin(angle), rng.uniform(34, 46)])
        views.append(View(lens, look_at(eye, np.array([0.0, 0, 4]) + rng.uniform(-3, 3, 3), UP)))
    return views


@cache
def low() -> Phantom:
    """Twenty markers around a specimen 12 mm high."""
    settings = PhantomSettings(
        seed=8,
        marker_ids=tuple(range(20)),
        specimen_mm=(46.0, 40.0, 12.0),
        photos=24,
        photo_size=448,
        mesh_divisions=64,
    )
    phantom = Phantom(settings)
    phantom.__dict__["views"] = low_views()
    return phantom


def poses_of(phantom: Phantom) -> tuple[Pose, ...]:
    return tuple(v.cam_from_world for v in phantom.views)


def test_the_box_ends_below_the_cameras_but_over_the_markers() -> None:
    corners, poses = low().truth.marker_corners, poses_of(low())
    free, cut = volume_over(corners), volume_over(corners, poses)
    assert free.high[2] > max(p.centre[2] for p in poses)  # the case that is meant
    assert cut.high[2] == pytest.approx(np.median([p.centre[2] for p in poses]))
    assert np.array_equal(cut.low, free.low)
    assert np.array_equal(cut.high[:2], free.high[:2])
    far = [Pose(p.R, -p.R @ (p.centre * 5)) for p in poses]
    assert np.array_equal(volume_over(corners, far).high, free.high)
    under = [Pose(p.R, -p.R @ (p.centre * [1, 1, 0.01])) for p in poses]
    assert volume_over(corners, under).high[2] > corners[..., 2].max() + 1


def test_depth_under_low_cameras_is_true() -> None:
    phantom, settings = low(), DepthSettings()
    images, poses = [image for _, image in phantom.photos()], poses_of(low())
    volume = volume_over(phantom.truth.marker_corners, poses)
    maps = dense_depth(images, phantom.views[0].intrinsics, poses, volume, settings, workers=2)
    assert len(maps) >= 0.9 * len(choose_pairs(poses, volume.centre, settings))
    off = []
    for one in maps:
        view = one.view(poses[one.photo])
        truth = true_depth(phantom.scene, view)
        rows, cols = np.nonzero((one.depth > 0) & (truth > 0))
        cam = view.intrinsics.rays(np.stack([cols, rows], -1).astype(float)) * truth[rows, cols, None]
        # The table's rim is seen at a grazing angle, next to what lies beyond it.
        inner = np.linalg.norm(view.cam_from_world.inverse().apply(cam)[:, :2], axis=1) < 40
        off.append((one.depth - truth)[rows, cols][inner])
    miss = np.abs(np.concatenate(off))
    assert len(miss) > 500_000
    assert 0.02 < np.median(miss) < 0.5
    assert 0 < (miss > 3).mean() < 0.08


def test_a_lattice_holds_the_corners_of_its_box() -> None:
    box = Volume(np.array([-1.0, -2, -3]), np.array([4.0, 5, 6]))
    points = {tuple(p) for p in box.lattice}
    assert {tuple(p) for p in box.vertices} <= points
    assert (lattice_over(box.low, box.high) >= box.low).all()
    assert (lattice_over(box.low, box.high) <= box.high).all()


# ---- what is said where depth is not found ------------------------------------------------------------


def refusal(images: list[Bytes], lens: Intrinsics, poses: tuple[Pose, ...], corners: Floats) -> DepthNotFoundError:
    with pytest.raises(DepthNotFoundError) as caught:
        dense_depth(images, lens, poses, volume_over(corners, poses), DepthSettings(), workers=2)
    assert caught.value.advice
    return caught.value


def test_black_photos_are_said_to_match_nothing() -> None:
    phantom = low()
    bare = [np.zeros((448, 448, 3), np.uint8)] * len(phantom.views)
    output = refusal(bare, phantom.views[0].intrinsics, poses_of(phantom), phantom.truth.marker_corners)
    assert "Hardly anything matches" in output.message
    assert output.details["pairs_with_depth"] == 0


def test_photos_from_opposite_sides_are_said_to_be_too_far_apart() -> None:
    phantom = low()
    bare = [np.zeros((448, 448, 3), np.uint8)] * 3
    poses = tuple(poses_of(phantom)[k] for k in (0, 8, 16))
    output = refusal(bare, phantom.views[0].intrinsics, poses, phantom.truth.marker_corners)
    assert "No two of the 3 photos" in output.message


def test_few_photos_all_around_are_said_to_lie_too_far_apart() -> None:
    """Seven photos round the specimen show the same, but look at it from 36 degrees apart."""
    lens = Intrinsics.centred(448, 448, 380.0)
    angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
    poses = tuple(look_at(np.array([130 * np.cos(a), 130 * np.sin(a), 150.0]), np.zeros(3), UP) for a in angles)
    corners = low().truth.marker_corners
    neighbours = np.sort(viewing_angles_deg(poses, volume_over(corners, poses).centre), axis=1)[:, 1]
    assert 33 < neighbours.min() < neighbours.max() < 42
    output = refusal([np.zeros((448, 448, 3), np.uint8)] * 7, lens, poses, corners)
    assert f"{np.median(neighbours):.0f} degrees apart: too far" in output.message
    assert "10 to 20 degrees" in output.advice


def test_two_maps_alone_are_no_surface() -> None:
    """Fusion wants three; what two show is refused where the reason is known."""
    assert SurfaceSettings().least_weight <= multi_view.LEAST_MAPS


def test_photos_of_single_markers_are_said_to_show_nothing_in_common() -> None:
    """Close-ups with a long lens, each of another place."""
    lens = Intrinsics.centred(224, 224, 1600.0)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    poses = tuple(
        look_at(np.array([20 * np.cos(a), 20 * np.sin(a), 150.0]), np.array([50 * np.cos(a), 50 * np.sin(a), 0.0]), UP)
        for a in angles
    )
    output = refusal([np.zeros((224, 224, 3), np.uint8)] * 12, lens, poses, low().truth.marker_corners)
    assert "too little in common" in output.message
    assert "150 mm above markers that span" in output.message

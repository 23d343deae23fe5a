"""Defects of phantoms that the others do not have: a specimen that moves between photos and cube."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from specimap_core.errors import SettingsError
from specimap_validation.phantom import Phantom, build_scene, write_phantom
from specimap_validation.phantom.settings import Stream
from specimap_validation.phantom.specimen import displacement
from tests.support.scenes import SMALL

STILL = replace(SMALL, photos=2, photo_size=96, cube_rows=96, cube_cols=120, bands=6, mesh_divisions=48)
MOVED = replace(STILL, moved_mm=(2.0, -1.5, 0.3), moved_deg=5.0, moved_tilt_deg=2.0)


@pytest.fixture(scope="module")
def still() -> Phantom:
    return Phantom(STILL)


@pytest.fixture(scope="module")
def moved() -> Phantom:
    return Phantom(MOVED)


@pytest.mark.slow
def test_photos_and_markers_do_not_know_of_the_motion(still: Phantom, moved: Phantom) -> None:
    for (_, a), (_, b) in zip(still.photos(), moved.photos(), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(still.truth.marker_corners, moved.truth.marker_corners)
    np.testing.assert_array_equal(still.truth.vertices, moved.truth.vertices)
    assert not np.array_equal(still.cube(), moved.cube())
    for kind in (2, 3):  # cards, tray: what is not hidden lies where it lay
        both = (still.truth.hsi_class == kind) & (moved.truth.hsi_class == kind)
        assert both.sum() > 200
        np.testing.assert_array_equal(still.truth.hsi_xyz[both], moved.truth.hsi_xyz[both])


def test_the_true_point_is_where_the_photos_show_the_tissue(still: Phantom, moved: Phantom) -> None:
    truth = moved.truth
    rows, cols = np.nonzero(truth.hsi_class == 1)
    tissue = truth.hsi_xyz[rows, cols].astype(float)
    # Carried along, it lies on the ray of the pixel that saw it; Embree counts in float32.
    there = displacement(MOVED).apply(tissue)
    assert np.abs(truth.hsi_view.project(there) - np.stack([cols, rows], -1)).max() < 1e-3
    # Turned by 5 degrees on a radius of up to 18 mm and shifted by 2.5 mm.
    off = np.linalg.norm(there - tissue, axis=1)
    assert 1.0 < off.min() < 2.5 < off.max() < 2.52 + 18 * np.radians(5) + 15 * np.radians(2)
    # It is the same tissue: the still cube shows that mixture where the point projects to.
    at = np.rint(still.truth.hsi_view.project(tissue)).astype(int)
    seen = still.truth.hsi_class[at[:, 1], at[:, 0]] == 1
    apart = still.truth.abundance[at[:, 1], at[:, 0]][seen] - truth.abundance[rows, cols][seen]
    unmoved = still.truth.abundance[rows, cols] - truth.abundance[rows, cols]
    assert seen.mean() > 0.9
    assert np.abs(apart).sum(1).mean() < 0.5 * np.abs(unmoved).sum(1).mean()


def test_detail_moves_with_the_tissue(still: Phantom, moved: Phantom) -> None:
    points = STILL.rng(Stream.SHAPE).uniform(-10, 10, (50, 3))
    by = displacement(MOVED)
    scene = build_scene(MOVED, by)
    np.testing.assert_allclose(scene.detail_at(by.apply(points)), still.scene.detail_at(points), atol=1e-4)
    assert moved.scene.moved is None, "the photos' scene is the still one"


def test_a_motion_of_zero_is_none() -> None:
    assert not STILL.moved
    assert all(replace(STILL, **change).moved for change in ({"moved_mm": (0.0, 0.0, 1.0)}, {"moved_deg": -1.0}))
    np.testing.assert_array_equal(displacement(STILL).matrix, np.eye(4))


@pytest.mark.parametrize("change", [{"moved_mm": (np.nan, 0.0, 0.0)}, {"moved_deg": np.inf}, {"moved_tilt_deg": 45.0}])
def test_a_motion_out_of_range_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(SettingsError) as refused:
        replace(STILL, **change)  # type: ignore[arg-type]
    assert refused.value.details["setting"] == "moved_mm"


def test_a_bare_photo_shows_the_same_scene_without_cards(still: Phantom) -> None:
    bare = Phantom(replace(STILL, bare_photos=(1,)))
    (_, same), (_, without) = bare.photos()
    (_, first), (_, with_cards) = still.photos()
    np.testing.assert_array_equal(same, first)
    outlines = still.scene.cards.outlines
    assert bare.truth.marker_corners.tolist() == still.truth.marker_corners.tolist()
    on_card = np.zeros(without.shape[:2], np.uint8)
    for outline in outlines:
        cv2.fillConvexPoly(on_card, np.rint(still.views[1].project(outline)).astype(np.int32), 1)
    changed = (without != with_cards).any(-1)
    around = cv2.dilate(on_card, np.ones((5, 5), np.uint8)) > 0
    assert not changed[~around].any()
    assert changed[on_card > 0].mean() > 0.8
    # Where cards lay, the picture is as bright and as even as the tray next to them.
    beside = (cv2.dilate(on_card, np.ones((9, 9), np.uint8)) > 0) & ~around
    assert abs(np.median(without[on_card > 0]) - np.median(without[beside])) < 10
    assert without[on_card > 0].std() < 1.5 * without[beside].std() < 0.7 * with_cards[on_card > 0].std()


def test_bare_photos_are_among_those_taken() -> None:
    with pytest.raises(SettingsError) as refused:
        replace(STILL, bare_photos=(2,))
    assert refused.value.details["setting"] == "bare_photos"


class StopError(Exception):
    """Raised by a listener."""


def test_writing_tells_how_far_it_is_and_can_be_stopped(tmp_path: Path) -> None:
    heard: list[float] = []
    write_phantom(STILL, tmp_path / "whole", progress=heard.append)
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
    assert len(heard) == STILL.photos + 2

    def stop(share: float) -> None:
        raise StopError

    with pytest.raises(StopError):
        write_phantom(replace(STILL, photos=60), tmp_path / "stopped", progress=stop)
    assert len(list((tmp_path / "stopped").rglob("*.jpg"))) == 1
    assert not (tmp_path / "stopped" / "truth.npz").exists()

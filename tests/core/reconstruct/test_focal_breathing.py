"""Focal lengths that differ from photo to photo: found against truth, taken out, and left alone where none differ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import rms_px
from specimap_core.fiducials.detection import detect_markers
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, fit_similarity
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photos, stated_focal_px
from specimap_core.reconstruct.backend import CornersInPhotos, corners_in_photos, detect_in_photos
from specimap_core.reconstruct.focal_breathing import (
    corners_at_shared_focal,
    correct_focal_breathing,
    estimate_focal_breathing,
    image_at_shared_focal,
)
from specimap_core.reconstruct.poses_from_markers import solve_from_markers
from specimap_validation.phantom import Phantom, PhantomSettings
from tests.support.scenes import EDGE_MM, marker_scene

SPREAD = 0.01
BREATHING_SEEDS = (21, 22)
SHARP = Intrinsics.centred(1024, 1024, 2000.0)
"""A lens that shows a marker as 90 pixels."""


@dataclass(frozen=True)
class Shown:
    """Photos of a phantom and what markers they show."""

    phantom: Phantom
    photos: list[Photo]
    corners: CornersInPhotos

    @property
    def true_zooms(self) -> Floats:
        """(P,) logarithms, 0 on average."""
        focal = np.log([v.intrinsics.focal_px for v in self.phantom.views])
        return np.asarray(focal - focal.mean())


def photo_of(name: str, image: np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]) -> Photo:
    return Photo(name, image, (image.shape[1], image.shape[0]), None, None, 1.0, name)


def detected(photos: list[Photo]) -> CornersInPhotos:
    found = detect_in_photos(photos, "DICT_4X4_50", workers=2, progress=lambda share: None)
    return corners_in_photos(photos, found, "DICT_4X4_50")


@cache
def shown(seed: int, spread: float, photos: int = 16, side: int = 512) -> Shown:
    """A phantom's photos, made once."""
    settings = PhantomSettings(seed=seed, photos=photos, photo_size=side, mesh_divisions=48, focal_spread=spread)
    phantom = Phantom(settings)
    pictures = [photo_of(name, image) for name, image in phantom.photos()]
    return Shown(phantom, pictures, detected(pictures))


@cache
def settled(seed: int) -> tuple[list[Photo], CornersInPhotos, Floats]:
    """The breathing phantom of a seed brought to one lens."""
    scene = shown(seed, SPREAD)
    return correct_focal_breathing(scene.photos, scene.corners, edge_mm=EDGE_MM, focal_px=None)


def layout_seen(
    seed: int, spread: float, *, photos: int = 10, markers: int = 4, noise_px: float = 0.05
) -> tuple[list[Photo], CornersInPhotos, Floats]:
    """Blank photos, corners of a layout seen through breathing lenses, and the logarithms (P,) of the true zooms."""
    _, seen = marker_scene(photos=photos, markers=markers, noise_px=noise_px, seed=seed, lens=SHARP)
    zooms = spread * np.random.default_rng([seed, 1]).standard_normal(photos)
    zooms -= zooms.mean()
    seen = corners_at_shared_focal(seen, np.exp(-zooms), (SHARP.width, SHARP.height))
    blank = photo_of("blank", np.zeros((SHARP.height, SHARP.width, 3), np.uint8))
    return [blank] * photos, CornersInPhotos(seen, tuple(range(markers))), zooms


def error_of(zooms: Floats, true: Floats) -> Floats:
    """(P,) of the logarithms, apart from what all share: that is the shared focal length's."""
    off = np.log(zooms) - true
    return np.asarray(off - off.mean())


# ---- found against truth ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", BREATHING_SEEDS)
def test_zooms_of_a_breathing_phantom_are_found(seed: int) -> None:
    scene = shown(seed, SPREAD)
    _, _, zooms = settled(seed)
    true = scene.true_zooms
    # At half the spread three quarters of what the breathing does to the poses, in squares, is gone.
    assert 1e-4 < error_of(zooms, true).std() < 0.5 * true.std()
    assert zooms.mean() == pytest.approx(1.0, abs=0.5 * SPREAD)
    assert np.corrcoef(np.log(zooms), true)[0, 1] > 0.9


@pytest.mark.slow
def test_zooms_of_layouts_are_found_as_well_as_stated() -> None:
    shares, chi = [], []
    for seed in range(3):
        photos, corners, true = layout_seen(seed, SPREAD)
        solution = solve_from_markers(corners.seen, corners.marker_ids, photos[0].size, edge_mm=EDGE_MM)
        found = estimate_focal_breathing(solution.scene, solution.seen)
        assert found is not None
        assert found.significance > 10
        assert found.spread == pytest.approx(true.std(), rel=0.5)
        _, _, zooms = correct_focal_breathing(photos, corners, edge_mm=EDGE_MM, focal_px=None)
        off = error_of(zooms, true)
        shares.append(off.std() / true.std())
        chi.append(float(np.mean((off / found.sd) ** 2)))
    assert 0.01 < np.median(shares) < 0.5
    # In standard deviations as stated, errors are about one; corners of one layout are shared among the photos.
    assert 0.2 < np.median(chi) < 4


def test_a_stated_focal_length_does_as_well() -> None:
    photos, corners, true = layout_seen(3, SPREAD)
    _, _, zooms = correct_focal_breathing(photos, corners, edge_mm=EDGE_MM, focal_px=1.02 * SHARP.focal_px)
    assert 1e-5 < error_of(zooms, true).std() < 0.5 * true.std()


@pytest.mark.slow
@pytest.mark.parametrize("seed", BREATHING_SEEDS)
def test_poses_come_nearer_to_truth(seed: int) -> None:
    scene = shown(seed, SPREAD)
    off: list[float] = []
    for corners in (scene.corners, settled(seed)[1]):
        solution = solve_from_markers(corners.seen, corners.marker_ids, scene.photos[0].size, edge_mm=EDGE_MM)
        rows = [scene.phantom.truth.marker_ids.tolist().index(i) for i in solution.markers]
        true = scene.phantom.truth.marker_corners[rows].reshape(-1, 3)
        _, R, t = fit_similarity(solution.scene.corners.reshape(-1, 3), true)
        centres = np.stack([p.centre for p in solution.scene.poses]) @ R.T + t
        truth = np.stack([scene.phantom.views[p].cam_from_world.centre for p in solution.photos])
        # A shared focal length that is off moves all cameras along their sight; breathing moves them apart.
        away = np.linalg.norm(centres, axis=1) / np.linalg.norm(truth, axis=1)
        off.append(float(np.log(away).std()))
    without, having = off
    assert 1e-5 < having < 0.6 * without


# ---- nothing is taken out where nothing breathes ------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [51, 52, 53])
def test_steady_phantoms_stay_as_they_are(seed: int) -> None:
    scene = shown(seed, 0.0, 12, 384)
    photos, corners, zooms = correct_focal_breathing(scene.photos, scene.corners, edge_mm=EDGE_MM, focal_px=None)
    assert (zooms == 1).all()
    assert photos is scene.photos
    assert corners.seen is scene.corners.seen


@pytest.mark.parametrize("noise_px", [0.05, 0.2, 0.5])
def test_steady_layouts_stay_as_they_are(noise_px: float) -> None:
    for seed in range(4):
        photos, corners, _ = layout_seen(100 + seed, 0.0, noise_px=noise_px)
        assert (correct_focal_breathing(photos, corners, edge_mm=EDGE_MM, focal_px=None)[2] == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phantom_a", "phantom_hard"])
def test_steady_path_traced_photos_stay_as_they_are(data_dir: Path, name: str) -> None:
    photos, _ = read_photos(photo_paths(data_dir / name / "rgb"), AcquisitionSettings(), workers=2)
    corners = detected(photos)
    after, _, zooms = correct_focal_breathing(photos, corners, edge_mm=EDGE_MM, focal_px=stated_focal_px(photos))
    assert (zooms == 1).all()
    assert after is photos


# ---- corners and images go together -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [0.98, 1.015])
def test_markers_of_a_warped_photo_lie_where_the_corners_were_brought(zoom: float) -> None:
    scene = shown(BREATHING_SEEDS[0], SPREAD)
    zooms = np.full(len(scene.photos), zoom)
    seen = scene.corners.seen
    brought = corners_at_shared_focal(seen, zooms, scene.photos[0].size)
    moved = np.linalg.norm(brought.corners_px - seen.corners_px, axis=-1)
    off = []
    for photo in range(0, len(scene.photos), 3):
        before = scene.photos[photo]
        warped = replace(before, image=image_at_shared_focal(before.image, zoom))
        for found in detect_markers(warped.grey, "DICT_4X4_50", expected=4):
            rows = (seen.photo == photo) & (seen.marker == scene.corners.marker_ids.index(found.marker_id))
            if rows.any():
                off.append(np.linalg.norm(found.corners_px - brought.corners_px[rows][0], axis=-1))
    apart = np.concatenate(off)
    assert len(apart) > 40
    # A corner's own noise is the same in both; that of sampling anew must not stand out from it.
    assert 1e-3 < np.median(apart) < np.median(seen.sigma_px)
    assert np.median(apart) < 0.1 * np.median(moved)


def test_photos_and_corners_are_brought_by_the_zooms_returned() -> None:
    scene = shown(BREATHING_SEEDS[0], SPREAD)
    photos, corners, zooms = settled(BREATHING_SEEDS[0])
    assert [p.name for p in photos] == [p.name for p in scene.photos]
    for before, after, zoom in zip(scene.photos, photos, zooms, strict=True):
        assert np.array_equal(after.image, image_at_shared_focal(before.image, float(zoom)))
    again = corners_at_shared_focal(scene.corners.seen, zooms, photos[0].size)
    assert np.array_equal(corners.seen.corners_px, again.corners_px)
    back = corners_at_shared_focal(corners.seen, 1 / zooms, photos[0].size)
    assert back.corners_px == pytest.approx(scene.corners.seen.corners_px, abs=1e-9)
    solution = corners.solution
    assert solution is not None
    assert np.isin(solution.seen.corners_px, corners.seen.corners_px).all()
    assert 0.01 < rms_px(solution.scene.residuals(solution.seen)) < 0.3


def test_the_middle_stays_and_a_zoom_too_small_to_see_moves_nothing() -> None:
    image = np.zeros((31, 41, 3), np.uint8)
    image[15, 20] = 255
    assert image_at_shared_focal(image, 1.0001) is image
    for zoom in (0.97, 1.03):
        warped = image_at_shared_focal(image, zoom)
        assert warped.shape == image.shape
        assert int(warped[..., 0].argmax()) == 15 * 41 + 20


# ---- too little to tell -------------------------------------------------------------------------------


def unchanged(photos: list[Photo], corners: CornersInPhotos) -> bool:
    after, brought, zooms = correct_focal_breathing(photos, corners, edge_mm=EDGE_MM, focal_px=None)
    same = after is photos and brought.seen is corners.seen and zooms.shape == (len(photos),)
    return same and bool((zooms == 1).all())


def test_two_photos_tell_nothing() -> None:
    photos, corners, _ = layout_seen(1, SPREAD, photos=2)
    assert unchanged(photos, corners)


def test_one_marker_tells_nothing() -> None:
    photos, corners, _ = layout_seen(1, SPREAD, markers=1)
    assert unchanged(photos, corners)


def test_markers_that_do_not_solve_are_left_to_what_refuses_them() -> None:
    photos, corners, _ = layout_seen(1, SPREAD, photos=4)
    rng = np.random.default_rng(5)
    places = rng.uniform(100, 900, (len(corners.seen.photo), 1, 2)) + rng.normal(0, 40, (len(corners.seen.photo), 4, 2))
    scrambled = Observations(corners.seen.photo, corners.seen.marker, places, corners.seen.sigma_px)
    assert unchanged(photos, replace(corners, seen=scrambled))


def test_a_photo_that_shows_one_marker_keeps_its_zoom() -> None:
    photos, corners, true = layout_seen(2, SPREAD)
    seen = corners.seen
    kept = (seen.photo != 4) | (seen.marker == 0)
    _, _, zooms = correct_focal_breathing(photos, replace(corners, seen=seen.of(kept)), edge_mm=EDGE_MM, focal_px=None)
    assert zooms[4] == 1
    rest = np.arange(len(photos)) != 4
    assert 1e-5 < error_of(zooms[rest], true[rest]).std() < 0.5 * true.std()

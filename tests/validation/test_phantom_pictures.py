"""Pictures of synthetic specimens show what the truth says, where it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, View, look_at
from specimap_validation.phantom import MATERIALS, Paint, Phantom, load_truth, render_view
from specimap_validation.phantom.materials import BLACK_INK
from tests.support.scenes import SMALL


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom(SMALL)


@pytest.fixture(scope="module")
def photos(phantom: Phantom) -> list[NDArray[np.uint8]]:
    return [image for _, image in phantom.photos()]


def detect(gray: NDArray[np.uint8]) -> dict[int, Floats]:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(gray)
    if ids is None:
        return {}
    return {int(i): c[0].astype(float) for i, c in zip(ids.ravel(), corners, strict=True)}


def area(polygon: Floats) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


@pytest.mark.slow
def test_markers_are_detected_where_the_truth_projects_them(phantom: Phantom, photos: list[NDArray[np.uint8]]) -> None:
    errors, seen = [], 0
    for image, view in zip(photos, phantom.truth.views, strict=True):
        found = detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
        seen += len(found) >= 3
        for marker_id, corners in found.items():
            true = view.project(phantom.truth.marker_corners[marker_id])
            distance = np.linalg.norm(corners[:, None] - true[None], axis=2)
            assert distance.argmin(1).tolist() == [0, 1, 2, 3]  # the order of the corners
            errors.append(np.diag(distance))
    assert seen >= 9
    assert tuple(phantom.truth.marker_ids) == SMALL.marker_ids
    assert 0.05 < float(np.median(errors)) < 1.0  # an unrefined detector is coarse, yet not coarser


def test_markers_are_detected_in_the_cube(phantom: Phantom) -> None:
    mean = phantom.cube().mean(2) / 10000 * 255
    enlarged = cv2.resize(np.clip(mean, 0, 255).astype(np.uint8), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    found = detect(np.asarray(enlarged, np.uint8))
    assert sorted(found) == list(SMALL.marker_ids)
    for marker_id, corners in found.items():
        true = phantom.truth.hsi_view.project(phantom.truth.marker_corners[marker_id])
        assert np.linalg.norm((corners + 0.5) / 3 - 0.5 - true, axis=1).max() < 1.0


def test_marker_edges_are_unbiased(phantom: Phantom) -> None:
    # The ink's own channel holds each pixel's share of ink: their sum is the area of the black cells.
    ink = np.zeros((len(MATERIALS), 1))
    ink[BLACK_INK] = 1
    paint = Paint.of(phantom.scene, ink, shading=0)
    cards = phantom.scene.cards
    centre = cards.corners[0].mean(0)
    view = View(
        Intrinsics.centred(200, 200, 900.0),
        look_at(centre + np.array([20.0, -40, 90]), centre, np.array([0, 0, 1.0])),
    )
    n = cards.white.shape[1]
    share = np.arange(n + 1) / n
    top_left, top_right, _, bottom_left = cards.corners[0]
    lattice = top_left + share[:, None, None] * (bottom_left - top_left) + share[None, :, None] * (top_right - top_left)
    cells = view.project(lattice)
    black = sum(
        area(np.stack([cells[r, c], cells[r, c + 1], cells[r + 1, c + 1], cells[r + 1, c]]))
        for r, c in np.argwhere(~cards.white[0])
    )
    image = render_view(phantom.scene, view, paint).image[..., 0]
    # 0.1 % of the area is 0.01 px on the edge of a marker of 60 px.
    assert image.sum() == pytest.approx(black, rel=1e-3)
    assert 0 < np.count_nonzero((image > 0) & (image < 1)) < 0.2 * image.size


def test_each_cube_pixel_sees_its_own_point(phantom: Phantom) -> None:
    truth = phantom.truth
    rows, cols = np.indices(truth.hsi_class.shape)
    pixels = truth.hsi_view.project(truth.hsi_xyz.astype(float))
    assert np.abs(pixels - np.stack([cols, rows], -1)).max() < 1e-3
    assert truth.hsi_xyz[truth.hsi_class == 3][:, 2] == pytest.approx(-0.2, abs=1e-3)
    assert truth.hsi_xyz[truth.hsi_class == 2][:, 2] == pytest.approx(0.0, abs=1e-3)


def test_classes_cover_what_the_specimen_and_the_cards_cover(phantom: Phantom) -> None:
    truth = phantom.truth
    mm2 = (400 / truth.hsi_view.intrinsics.focal_px) ** 2
    specimen, cards = ((truth.hsi_class == k).sum() * mm2 for k in (1, 2))
    assert cards == pytest.approx(4 * SMALL.card_mm**2, rel=0.03)
    assert 0.75 < specimen / (np.pi / 4 * 33 * 28) < 1.15
    assert not np.isin(truth.hsi_class, (0, 4)).any()


def test_photos_show_fine_contrast_on_the_specimen(phantom: Phantom, photos: list[NDArray[np.uint8]]) -> None:
    paint = Paint.of(phantom.scene, np.ones((len(MATERIALS), 1)))
    view, image = phantom.views[0], photos[0]
    on = render_view(phantom.scene, view, paint).classes == 1
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    local = np.sqrt(np.maximum(cv2.blur(gray**2, (7, 7)) - cv2.blur(gray, (7, 7)) ** 2, 0))
    noise = SMALL.noise * 255
    assert (local[on] > 3 * noise).mean() > 0.9
    assert on.mean() > 0.05


def test_cameras_stand_all_around_and_a_few_above(phantom: Phantom) -> None:
    centres = np.stack([v.cam_from_world.centre for v in phantom.views])
    directions = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert elevation.min() > 28
    assert 1 <= (elevation > 68).sum() <= 3
    azimuth = np.sort(np.arctan2(centres[:, 1], centres[:, 0]))
    assert np.degrees(np.diff(azimuth, append=azimuth[0] + 2 * np.pi)).max() < 60


def test_lens_distortion_is_in_the_photo() -> None:
    settings = replace(SMALL, photos=1, k1=-0.25, k2=0.1, marker_ids=(5,), mesh_divisions=16, specimen_mm=(8, 8, 4))
    phantom = Phantom(settings)
    (_, image), view = next(phantom.photos()), phantom.views[0]
    found = detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
    true = view.project(phantom.truth.marker_corners[0])
    assert np.linalg.norm(found[5] - true, axis=1).max() < 1.5


@pytest.mark.parametrize(("name", "photos", "bands"), [("phantom_a", 24, 64), ("phantom_hard", 26, 24)])
def test_the_path_traced_phantoms_load_alike(data_dir: Path, name: str, photos: int, bands: int) -> None:
    truth = load_truth(data_dir / name / "truth.npz")
    assert len(truth.views) == len(truth.photo_names) == photos
    assert truth.views[0].intrinsics.width == truth.views[0].intrinsics.height == 512
    assert truth.materials == MATERIALS
    assert truth.endmembers.shape == (9, bands)
    rows, cols = np.indices(truth.hsi_class.shape)
    pixels = truth.hsi_view.project(truth.hsi_xyz.astype(float))
    hit = truth.hsi_class > 0
    assert np.abs(pixels - np.stack([cols, rows], -1))[hit].max() < 0.02
    image = cv2.imread(str(data_dir / name / truth.photo_names[3]), cv2.IMREAD_GRAYSCALE)
    found = detect(np.asarray(image, np.uint8))
    assert found
    for marker_id, corners in found.items():
        true = truth.views[3].project(truth.marker_corners[marker_id])
        assert np.median(np.linalg.norm(corners - true, axis=1)) < 2

"""How much detail photos hold, told by their markers: of pictures whose blur is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.fiducials.detection import detect_markers
from specimap_core.fiducials.subpixel import edge_blurs
from specimap_core.photos.colour import linear_from_srgb
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.photo_resolution import LEAST_PX, SHARP_PX, at_own_resolution, own_resolution
from tests.support.marker_pictures import LAYOUT, picture

SHAPE = (780, 1040)
LARGE = {k: 2.6 * (corners + 0.5) - 0.5 for k, corners in LAYOUT.items()}


def photo(grey: NDArray[np.uint8], name: str = "a.jpg") -> Photo:
    image = np.repeat(grey[..., None], 3, axis=2)
    return Photo(name, image, (grey.shape[1], grey.shape[0]), 900.0, None, 1.0, name)


def shown(blur_px: float) -> NDArray[np.uint8]:
    return picture(LARGE, shape=SHAPE, blur_px=blur_px)


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.5, 0.8, 1.2, 1.8])
def test_the_blur_of_edges_is_measured(blur_px: float) -> None:
    blurs = edge_blurs(linear_from_srgb(shown(blur_px)), np.stack(list(LARGE.values())))
    assert blurs.shape == (16,)
    # A pixel's own area adds to it.
    assert np.median(blurs) == pytest.approx(np.hypot(blur_px, 12**-0.5), abs=0.08)


def test_an_edge_that_is_none_has_no_blur() -> None:
    blurs = edge_blurs(np.full((90, 90), 0.5, np.float32), np.array([[[20, 20], [60, 20], [60, 60], [20, 60]]], float))
    assert np.isnan(blurs).all()


@pytest.mark.slow
def test_sharp_photos_stay_as_they_are() -> None:
    photos = [photo(shown(0.35), name) for name in "ab"]
    found = [detect_markers(p.grey, "DICT_4X4_50") for p in photos]
    same, there = at_own_resolution(photos, found)
    assert same is photos
    assert there is found


@pytest.mark.slow
def test_soft_photos_are_brought_to_what_they_resolve() -> None:
    blur = 0.9
    photos = [photo(shown(blur), name) for name in "ab"]
    found = [detect_markers(p.grey, "DICT_4X4_50") for p in photos]
    small, there = at_own_resolution(photos, found)
    share = small[0].size[0] / SHAPE[1]
    assert share == pytest.approx(SHARP_PX / np.hypot(blur, 12**-0.5), abs=0.06)
    assert small[0].size[0] / small[0].size[1] == pytest.approx(SHAPE[1] / SHAPE[0], abs=1e-4)
    assert small[0].focal_px == pytest.approx(900 * share)
    assert small[0].full_size == photos[0].full_size
    # A marker lies where it shows in the smaller photo.
    again = detect_markers(small[0].grey, "DICT_4X4_50", expected=4)
    for moved, seen in zip(there[0], again, strict=True):
        assert np.abs(moved.corners_px - seen.corners_px).max() < 0.25
        assert moved.marker_id == seen.marker_id


@pytest.mark.slow
def test_one_soft_photo_among_sharp_ones_changes_nothing() -> None:
    photos = [photo(shown(b), str(b)) for b in (0.35, 0.36, 0.37, 2.0)]
    assert own_resolution(photos, [detect_markers(p.grey, "DICT_4X4_50") for p in photos]) == 1


@pytest.mark.slow
def test_photos_keep_the_pixels_that_are_asked_of_all() -> None:
    photos = [photo(shown(2.5), name) for name in "ab"]
    found = [detect_markers(p.grey, "DICT_4X4_50", expected=4) for p in photos]
    assert sum(map(len, found)) >= 4
    assert LEAST_PX <= at_own_resolution(photos, found)[0][0].size[0] <= 1.04 * LEAST_PX


def test_without_markers_nothing_is_told() -> None:
    plain = photo(np.full(SHAPE, 90, np.uint8))
    assert own_resolution([plain], [[]]) == 1
    assert at_own_resolution([], []) == ([], [])


def test_a_photo_whose_markers_have_no_edge_is_left_out_of_account() -> None:
    """Overexposed, a marker may read whose edges are no steps any more."""
    plain, soft = photo(np.full(SHAPE, 90, np.uint8), "p"), photo(shown(1.8), "s")
    found = detect_markers(soft.grey, "DICT_4X4_50")
    assert own_resolution([plain], [found]) == 1
    assert own_resolution([plain, soft], [found, found]) == own_resolution([soft], [found]) < 0.9


@pytest.mark.slow
def test_the_portrait_of_a_landscape_keeps_square_pixels() -> None:
    turned = [photo(np.ascontiguousarray(np.rot90(shown(0.9)))) for _ in range(2)]
    found = [detect_markers(p.grey, "DICT_4X4_50") for p in turned]
    width, height = at_own_resolution(turned, found)[0][0].size
    assert width < height
    assert height / width == pytest.approx(SHAPE[1] / SHAPE[0], abs=1e-4)
    assert cv2.resize(turned[0].grey, (width, height)).shape == (height, width)

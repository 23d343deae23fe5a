"""In which light edges lie where they are: pictures blurred before and after they are encoded."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.fiducials.detection import Detection, detect_markers, dictionary_named, measured_at, tone_of
from specimap_core.fiducials.tone import LEAST_CELLS, RANGE, cell_borders, tone_between
from tests.support.marker_pictures import LAYOUT, picture

FACTOR = 2.5
LARGE = {k: FACTOR * (corners + 0.5) - 0.5 for k, corners in LAYOUT.items()}
DICTIONARY = "DICT_4X4_50"


def enlarged() -> NDArray[np.uint8]:
    """As a phone's digital zoom makes it: interpolated as encoded."""
    small = picture(LAYOUT, blur_px=0.4)
    size = round(FACTOR * small.shape[1]), round(FACTOR * small.shape[0])
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def shrunk() -> NDArray[np.uint8]:
    """As a large photo is brought to fewer pixels: averaged as encoded."""
    fine = picture({k: 3 * (c + 0.5) - 0.5 for k, c in LARGE.items()}, shape=(2250, 3000), blur_px=0.4)
    return np.asarray(cv2.resize(fine, (1000, 750), interpolation=cv2.INTER_AREA), np.uint8)


def outward(found: list[Detection]) -> float:
    """By how many pixels black has grown at the markers' edges, on average."""
    out = []
    for d in found:
        truth = LARGE[d.marker_id]
        away = truth - truth.mean(0)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        out.append(((d.corners_px - truth) * away).sum(1).mean() / np.sqrt(2))
    return float(np.mean(out))


@pytest.mark.slow
@pytest.mark.parametrize("make", [enlarged, shrunk])
def test_photos_resized_as_encoded_keep_their_markers_size(make: object) -> None:
    assert callable(make)
    grey = make()
    found = detect_markers(grey, DICTIONARY)
    tone = tone_of([grey], [found], DICTIONARY)
    before, after = outward(found), outward(measured_at(grey, found, tone))
    assert RANGE[0] <= tone < 0.9
    assert before > 0.07
    assert abs(after) < 0.3 * before


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.5, 1.0, 1.5])
def test_what_a_lens_blurs_is_measured_in_linear_light(blur_px: float) -> None:
    grey = picture(LARGE, shape=(750, 1000), blur_px=blur_px)
    found = detect_markers(grey, DICTIONARY)
    assert tone_of([grey], [found], DICTIONARY) == pytest.approx(1, abs=0.1)
    assert abs(outward(found)) < 0.02


def test_cells_lie_where_the_marker_draws_them() -> None:
    number = cv2.aruco.DICT_5X5_100
    borders, levers = cell_borders(number, 7)
    side = 140
    drawn = cv2.aruco.generateImageMarker(dictionary_named("DICT_5X5_100"), 7, side)
    assert len(borders) == len(levers) > 10
    for first, second, black in borders:
        middle = (first + second) / 2
        white = 2 * middle - black
        at = [tuple(np.floor(place * side).astype(int)) for place in (black, white)]
        assert [drawn[y, x] for x, y in at] == [0, 255]
    assert (levers > 0).all()
    assert (levers < 2).all()


def test_too_few_cells_tell_nothing() -> None:
    few = np.full(LEAST_CELLS - 1, 0.3)
    assert tone_between([few, few - 0.2]) == 1
    assert tone_of([], [], DICTIONARY) == 1
    assert tone_of([np.full((50, 50), 9, np.uint8)], [[]], DICTIONARY) == 1


def test_a_tone_stays_within_what_a_camera_does() -> None:
    many = np.zeros(LEAST_CELLS)
    assert tone_between([many + 1, many + 0.9]) == RANGE[0]
    assert tone_between([many - 1, many - 1.1]) == RANGE[1]
    assert tone_between([many + 0.1, many + 0.1]) == 1
    assert tone_between([many + 0.1, many - 0.1]) == pytest.approx(0.8)

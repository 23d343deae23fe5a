"""Marker corners: found, without bias, and in the standard order."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Bytes
from specimap_core.errors import (
    DuplicateMarkersError,
    NoMarkersFoundError,
    UnknownDictionaryError,
    WrongDictionaryError,
)
from specimap_core.fiducials import subpixel
from specimap_core.fiducials.detection import detect_markers, dictionary_named, fitting_dictionaries
from specimap_core.fiducials.subpixel import refine_corners
from specimap_core.photos.colour import linear_from_srgb
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photo
from specimap_core.reconstruct.backend import corners_in_photos
from tests.support.marker_pictures import LAYOUT, picture, square


@pytest.mark.parametrize("blur_px", [0.6, 1.0])
def test_corners_are_found_where_they_are(blur_px: float) -> None:
    found = detect_markers(picture(LAYOUT, blur_px=blur_px), "DICT_4X4_50", expected=4)
    assert [d.marker_id for d in found] == [0, 1, 2, 3]
    errors = np.stack([d.corners_px - LAYOUT[d.marker_id] for d in found])
    distance = np.linalg.norm(errors, axis=-1)
    assert 0.002 < np.median(distance) < 0.08
    assert distance.max() < 0.25


def test_corners_are_not_pulled_inward() -> None:
    """OpenCV's own refinement on the encoded picture is; lines on linear light are not."""
    inward: dict[str, list[float]] = {"lines": [], "subpix": []}
    for seed in range(4):
        grey = picture(LAYOUT, blur_px=1.1, seed=seed)
        for d in detect_markers(grey, "DICT_4X4_50"):
            truth = LAYOUT[d.marker_id]
            outward = truth - truth.mean(0)
            outward /= np.linalg.norm(outward, axis=1, keepdims=True)
            coarse = d.corners_px.astype(np.float32)[:, None]
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
            subpix = cv2.cornerSubPix(grey, coarse.copy(), (4, 4), (-1, -1), criteria)[:, 0]
            inward["lines"] += list(-((d.corners_px - truth) * outward).sum(1))
            inward["subpix"] += list(-((subpix - truth) * outward).sum(1))
    assert abs(float(np.mean(inward["lines"]))) < 0.04
    assert float(np.mean(inward["subpix"])) > 0.1


def test_the_stated_sigma_is_of_the_errors_size() -> None:
    errors, sigmas = [], []
    for seed in range(6):
        for d in detect_markers(picture(LAYOUT, noise=4.0, seed=seed), "DICT_4X4_50"):
            errors.append(d.corners_px - LAYOUT[d.marker_id])
            sigmas.append(d.sigma_px)
    ratio = float(np.std(errors)) / float(np.median(sigmas))
    assert 0.3 < ratio < 3.0


def test_squares_of_all_sizes_are_measured_together_as_alone() -> None:
    """Profiles of different lengths stand next to each other; what pads the short ones must not count."""
    places = {0: square(40.3, 50.7, 17.2, 12), 1: square(120.6, 60.1, 38.5, -33), 2: square(270.2, 170.4, 150.9, 61)}
    light = linear_from_srgb(picture(places, noise=0.5))
    truth = np.stack(list(places.values()))
    start = truth + np.random.default_rng(1).uniform(-0.4, 0.4, truth.shape)
    together, sigmas = refine_corners(light, start)
    distance = np.linalg.norm(together - truth, axis=-1)
    assert distance.min() > 0.001
    assert distance.max() < 0.15
    for k in range(len(truth)):
        alone, sigma = refine_corners(light, start[k : k + 1])
        assert np.allclose(alone[0], together[k], atol=1e-9)
        assert sigma[0] == pytest.approx(sigmas[k])
        assert 0.005 < sigma[0] < 0.1


def covered(low: float, high: float, count: int) -> NDArray[np.float32]:
    """Share of each of ``count`` pixels that lies between two places."""
    pixels = np.arange(count)
    share = np.minimum(high, pixels + 0.5) - np.maximum(low, pixels - 0.5)
    return np.asarray(np.clip(share, 0, 1), np.float32)


def test_sharp_edges_along_the_pixels_are_found_between_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """All profiles of such an edge are sampled alike, so that nothing averages out: blurring them first does."""
    softened = between_pixels()
    monkeypatch.setattr(subpixel, "EDGE_PX", 0.0)
    assert 0.0005 < softened < between_pixels() / 2


def between_pixels() -> float:
    """Largest error, px, of the corners of a sharp square whose edges run along the pixels, wherever between them."""
    errors = []
    for phase in np.linspace(0, 1, 11):
        low, high = 20 + np.array([phase, 0.7 * phase]), 61.3 + np.array([0.4 * phase, phase])
        black = covered(low[1], high[1], 90)[:, None] * covered(low[0], high[0], 90)
        truth = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        found, _ = refine_corners(0.75 - 0.7 * black, truth[None] + 0.3)
        errors.append(found[0] - truth)
    return float(np.abs(errors).max())


def test_a_square_without_edges_keeps_its_corners() -> None:
    places = {0: square(80.3, 70.7, 41.2, 12)}
    light = linear_from_srgb(picture(places))
    outside = places[0] - places[0].min(0) + [402.0, 120.0]
    blank = np.zeros_like(light)
    for image, start in ((light, outside), (blank, places[0])):
        corners, sigma = refine_corners(image, start[None])
        assert np.allclose(corners[0], start, atol=1e-9)
        assert 0.5 <= sigma[0] < 1


def test_a_defocused_marker_is_found_by_the_second_search() -> None:
    grey = picture({5: square(200.3, 150.2, 26, 10)}, blur_px=2.0)
    assert not detect_markers(grey, "DICT_4X4_50", expected=0)
    assert [d.marker_id for d in detect_markers(grey, "DICT_4X4_50", expected=1)] == [5]


def test_a_covered_edge_is_told_by_a_large_sigma() -> None:
    grey = picture({7: square(200, 150, 60)})
    clean = detect_markers(grey, "DICT_4X4_50")[0].sigma_px
    grey[120:180, 172:186] = grey[0, 0]  # paper over the border's inner part on one side: the edge stays, ragged
    ragged = grey.copy()
    rng = np.random.default_rng(0)
    ragged[118:182, 165:172] = rng.integers(40, 220, (64, 7), dtype=np.uint8)
    for d in detect_markers(ragged, "DICT_4X4_50", expected=1):
        assert d.sigma_px > clean


def test_an_unknown_dictionary_is_refused_with_the_known_ones() -> None:
    for name in ("DICT_4X4_51", "CORNER_REFINE_NONE", "", "__class__"):
        with pytest.raises(UnknownDictionaryError) as refused:
            dictionary_named(name)
        assert "DICT_4X4_50" in refused.value.advice


def test_the_fitting_dictionary_is_named() -> None:
    shown = [picture(LAYOUT, dictionary="DICT_5X5_100", seed=s) for s in range(3)]
    assert next(iter(fitting_dictionaries(shown))) == "DICT_5X5_1000"
    rng = np.random.default_rng(0)
    texture = [cv2.GaussianBlur(rng.integers(0, 256, (300, 400), dtype=np.uint8), (0, 0), 4) for _ in range(3)]
    assert not fitting_dictionaries([np.asarray(cv2.normalize(t, None, 0, 255, cv2.NORM_MINMAX)) for t in texture])


def test_linear_light_is_srgbs() -> None:
    values = np.arange(256, dtype=np.uint8)
    linear = linear_from_srgb(values)
    assert linear[0] == 0
    assert linear[255] == 1
    assert np.isclose(linear[128], 0.2158605, atol=1e-6)
    assert (np.diff(linear) > 0).all()


# ---- all photos together ------------------------------------------------------------------------------


def photo_of(grey: Bytes, name: str) -> Photo:
    image = np.repeat(grey[..., None], 3, axis=2)
    return Photo(name, image, (grey.shape[1], grey.shape[0]), None, None, 1.0, name)


def gathered(greys: list[Bytes], dictionary: str = "DICT_4X4_50") -> tuple[int, ...]:
    photos = [photo_of(g, f"{k}.jpg") for k, g in enumerate(greys)]
    found = [detect_markers(g, dictionary) for g in greys]
    return corners_in_photos(photos, found, dictionary).marker_ids


def test_an_id_on_two_markers_is_refused() -> None:
    rng = np.random.default_rng(0)
    pictures = []
    for k in range(5):
        grey = picture(LAYOUT, seed=k)
        other = picture({0: square(200 + rng.uniform(-2, 2), 150, 40)}, seed=k)
        grey[110:190, 160:240] = other[110:190, 160:240]
        pictures.append(grey)
    with pytest.raises(DuplicateMarkersError) as refused:
        gathered(pictures)
    assert refused.value.details["ids"] == [0]


def test_a_false_reading_in_one_photo_is_left_out() -> None:
    pictures = [picture(LAYOUT, seed=k) for k in range(4)]
    stray = picture({17: square(200, 150, 30)})
    pictures[0][110:190, 160:240] = stray[110:190, 160:240]
    assert gathered(pictures) == (0, 1, 2, 3)


@pytest.mark.slow
def test_another_dictionary_is_named_even_where_the_given_one_reads_a_few() -> None:
    pictures = [picture(LAYOUT, dictionary="DICT_6X6_250", seed=k) for k in range(6)]
    with pytest.raises(WrongDictionaryError) as refused:
        gathered(pictures)
    assert "DICT_6X6_1000" in refused.value.advice
    for k in (0, 1):  # the same false marker in two photos counts as seen
        stray = picture({17: square(200, 150, 30)})
        pictures[k][110:190, 160:240] = stray[110:190, 160:240]
    with pytest.raises(WrongDictionaryError):
        gathered(pictures)


@pytest.mark.slow
def test_no_marker_anywhere_is_refused_as_that() -> None:
    rng = np.random.default_rng(1)
    greys = [
        np.asarray(cv2.GaussianBlur(rng.integers(0, 256, (300, 400), dtype=np.uint8), (0, 0), 2), np.uint8)
        for _ in range(6)
    ]
    with pytest.raises(NoMarkersFoundError) as refused:
        gathered(greys)
    assert refused.value.code == "no_markers_found"


# ---- real pictures ------------------------------------------------------------------------------------


def real(data_dir: Path, name: str) -> Bytes:
    return read_photo(data_dir / name, AcquisitionSettings(working_px=4000)).grey


@pytest.mark.parametrize(
    ("name", "count"), [("singlemarkersoriginal.jpg", 6), ("choriginal.jpg", 17), ("chocclusion_original.jpg", 13)]
)
def test_real_markers_are_read(data_dir: Path, name: str, count: int) -> None:
    found = detect_markers(real(data_dir, f"real_fiducial_opencv/{name}"), "DICT_6X6_250", expected=count)
    assert abs(len(found) - count) <= 1
    assert len({d.marker_id for d in found}) == len(found)
    # Real print and paper: edges are found on most, and the sigma says how well.
    assert 0.005 < float(np.median([d.sigma_px for d in found])) < 0.3


def test_one_id_on_two_real_tags_is_reported_twice(data_dir: Path) -> None:
    counts = []
    for path in sorted((data_dir / "real_fiducial_apriltag").glob("*.jpg")):
        ids = [d.marker_id for d in detect_markers(real(data_dir, str(path)), "DICT_APRILTAG_36h11")]
        counts.append(len(ids) - len(set(ids)))
    assert max(counts) >= 1

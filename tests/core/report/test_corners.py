"""Corners and residuals that a report keeps: of the right photo, marker and side, where the indices do not line up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.bundle_adjust.adjust import Adjusted, AdjustSettings, adjust
from specimap_core.geometry.cameras import Intrinsics, View
from specimap_core.photos.reading import Refusal
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.pipeline.corners import cube_corners, photo_corners
from specimap_core.reconstruct.backend import CornersInPhotos, Reconstruction
from specimap_core.register.cube_markers import CubeMarkers
from tests.support.scenes import EDGE_MM, marker_scene

NOISE_PX = 0.2
IDS = (3, 5, 8, 9)
REFUSED, LONELY = 2, 1
"""A photo that was not posed; a marker (its index) that one photo alone shows."""


def stage_one() -> tuple[Stage1, NDArray[np.bool_]]:
    """Seven photos of four markers, and which observations (M,) a report should hold."""
    scene, seen = marker_scene(photos=7, markers=4, noise_px=NOISE_PX)
    shown = seen.of((seen.marker != LONELY) | (seen.photo == 4))
    photos = tuple(p for p in range(7) if p != REFUSED)
    reconstruction = Reconstruction(
        photos,
        scene.lens,
        tuple(scene.poses[p] for p in photos),
        (),
        np.zeros((0, 3), np.float32),
        (Refusal("p2.jpg", "photo_blurred", "Blurred."),),
        (),
    )
    names = tuple(f"p{p}.jpg" for p in range(7))
    kept = (shown.photo != REFUSED) & (shown.marker != LONELY)
    return Stage1(reconstruction, CornersInPhotos(shown, IDS), names, (), None, ()), kept


def adjusted_of(stage: Stage1) -> Adjusted:
    seen, r = stage.corners.seen, stage.reconstruction
    posed = seen.of(np.isin(seen.photo, r.photos))
    posed = replace(posed, photo=np.searchsorted(r.photos, posed.photo))
    return adjust(r.lens, r.poses, posed, IDS, AdjustSettings(edge_mm=EDGE_MM))


def test_photos_and_markers_that_are_left_out() -> None:
    stage, kept = stage_one()
    adjusted, seen, r = adjusted_of(stage), stage.corners.seen, stage.reconstruction
    assert adjusted.marker_ids == (3, 8, 9)
    found = photo_corners(stage, adjusted)
    assert [photo.name for photo in found] == [f"p{p}.jpg" for p in r.photos]
    for k, (photo, index) in enumerate(zip(found, r.photos, strict=True)):
        own = seen.of(kept & (seen.photo == index))
        assert photo.marker_ids == [IDS[m] for m in own.marker]
        measured = np.array(photo.corners_px).reshape(-1, 4, 2)
        # Rounded to a tenth of a pixel.
        assert np.abs(measured - own.corners_px).max() <= 0.05 + 1e-9
        view = View(adjusted.lens, adjusted.poses[k])
        rows = [adjusted.marker_ids.index(i) for i in photo.marker_ids]
        expected = view.project(adjusted.corners[rows]) - own.corners_px
        assert np.abs(np.array(photo.residuals_px).reshape(-1, 4, 2) - expected).max() <= 0.005 + 1e-9
    lengths = np.linalg.norm(np.concatenate([np.array(p.residuals_px).reshape(-1, 2) for p in found]), axis=1)
    # Noise of two coordinates, less what the adjustment takes up.
    assert 0.5 * NOISE_PX < np.sqrt((lengths**2).mean()) < 2 * NOISE_PX


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_mirrored_cube_keeps_its_own_columns(mirrored: bool) -> None:
    stage, _ = stage_one()
    adjusted = adjusted_of(stage)
    rows, cols = 480, 640
    view = View(Intrinsics(cols, rows, 900.0, cols / 2, rows / 2), adjusted.poses[0])
    shift = np.array([0.25, -0.5])
    pixels = view.project(adjusted.corners[[2, 0]]) - shift
    if mirrored:
        pixels[..., 0] = cols - 1 - pixels[..., 0]
    blank = np.zeros((rows, cols), np.float32)
    found = CubeMarkers((9, 3), pixels, np.full(2, 0.1), blank, "band mean", mirrored)
    kept = cube_corners(found, adjusted, view, rows, cols)
    assert (kept.rows, kept.cols, kept.marker_ids) == (rows, cols, [9, 3])
    assert np.abs(np.array(kept.corners_px).reshape(2, 4, 2) - pixels).max() <= 0.05 + 1e-9
    expected = shift * [-1 if mirrored else 1, 1]
    assert np.abs(np.array(kept.residuals_px).reshape(2, 4, 2) - expected).max() <= 0.005 + 1e-9

"""Matching at a share of the photos' size: how far photos are shrunk, and depth against truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.errors import CancelledError
from specimap_core.geometry.cameras import Intrinsics
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.surface.refinement import pixel_footprint_mm
from tests.support.matched_scene import Matched, matched
from tests.support.true_depth import true_depth

pytestmark = pytest.mark.slow

SEEDS = (31, 32)
GROSS_MM = 1.5
"""Depths farther off see another surface: they are counted, not averaged."""


# ---- how far photos are shrunk ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "shrinkage"),
    [
        ((512, 512), 0.6),
        ((384, 288), 0.6),
        ((853, 640), 0.6),
        ((1280, 960), 0.4),
        ((960, 1280), 0.4),
        ((4000, 3000), 0.128),
    ],
)
def test_small_photos_are_matched_at_a_share_and_large_ones_at_a_size(size: tuple[int, int], shrinkage: float) -> None:
    lens = Intrinsics.centred(*size, 1.2 * max(size))
    found = DepthSettings().shrinkage(lens)
    assert found == pytest.approx(shrinkage)
    assert found * max(size) <= 512 + 1e-9


def test_the_share_and_the_size_can_be_set() -> None:
    lens = Intrinsics.centred(1280, 960, 1500.0)
    assert DepthSettings(matching_share=0.25).shrinkage(lens) == 0.25
    assert DepthSettings(most_matching_px=320).shrinkage(lens) == 0.25
    assert DepthSettings(matching_share=1.0, most_matching_px=5000).shrinkage(lens) == 1.0


@pytest.mark.parametrize("seed", SEEDS[:1])
def test_virtual_cameras_have_the_shrunk_focal_length(seed: int) -> None:
    scene = matched(seed)
    assert scene.maps
    for one in scene.maps:
        assert one.intrinsics.focal_px == pytest.approx(0.6 * scene.lens.focal_px)
        assert one.depth.shape == (one.intrinsics.height, one.intrinsics.width)
        assert one.colour.shape == (*one.depth.shape, 3)
        assert ((one.confidence > 0) == (one.depth > 0)).all()


# ---- depth against truth ------------------------------------------------------------------------------


def errors_of(scene: Matched, maps: tuple[DepthMap, ...]) -> Floats:
    """Depth less true depth, mm, of the known pixels of all maps."""
    off = []
    for one in maps:
        truth = true_depth(scene.phantom.scene, one.view(scene.poses[one.photo]))
        known = (one.depth > 0) & (truth > 0)
        off.append((one.depth - truth)[known].astype(float))
    return np.concatenate(off)


def matched_at(scene: Matched, share: float) -> tuple[DepthMap, ...]:
    settings = DepthSettings(matching_share=share)
    return tuple(dense_depth(scene.images, scene.lens, scene.poses, scene.volume, settings, workers=2))


@pytest.mark.parametrize("seed", SEEDS)
def test_depth_of_shrunk_photos_is_unbiased(seed: int) -> None:
    scene = matched(seed)
    off = errors_of(scene, scene.maps)
    assert len(off) > 100_000
    gross = np.abs(off) > GROSS_MM
    # At silhouettes a window lies on both surfaces: a pixel or two along them, a few per cent of a map.
    assert 0 < gross.mean() < 0.05
    near = off[~gross]
    # A matched pixel on the specimen; a disparity of a sixteenth of it, at 14 degrees, is a quarter of it in depth.
    pixel_mm = pixel_footprint_mm(scene.lens, scene.poses, scene.volume.centre) / 0.6
    one_step = pixel_mm / 16 / np.tan(np.radians(14.0))
    assert abs(np.median(near)) < one_step
    # Scatter: more than the step that disparities are counted in, less than two matched pixels.
    assert one_step / 4 < np.percentile(np.abs(near), 68) < 2 * pixel_mm


def test_shrinking_shifts_depth_no_more_than_a_step() -> None:
    scene = matched(SEEDS[0])
    full, shrunk = (errors_of(scene, maps) for maps in (matched_at(scene, 1.0), scene.maps))
    pixel_mm = pixel_footprint_mm(scene.lens, scene.poses, scene.volume.centre) / 0.6
    medians = [float(np.median(off[np.abs(off) < GROSS_MM])) for off in (full, shrunk)]
    assert 0 < abs(medians[0] - medians[1]) < pixel_mm / 16 / np.tan(np.radians(14.0))


# ---- a stop -------------------------------------------------------------------------------------------


def test_progress_rises_to_one_and_what_it_raises_ends_the_work() -> None:
    scene = matched(SEEDS[0])
    few = replace(DepthSettings(), matching_share=0.3)
    heard: list[float] = []
    dense_depth(scene.images, scene.lens, scene.poses, scene.volume, few, workers=2, progress=heard.append)
    assert heard == sorted(heard)
    assert heard[-1] == pytest.approx(1.0)

    described: list[float] = []

    def stop(share: float) -> None:
        described.append(share)
        raise CancelledError("Stopped.", advice="Run again.")

    with pytest.raises(CancelledError):
        dense_depth(scene.images, scene.lens, scene.poses, scene.volume, few, workers=2, progress=stop)
    assert len(described) == 1

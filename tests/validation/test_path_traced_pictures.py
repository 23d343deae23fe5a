"""Path-traced pictures lie where the truth says. Without Mitsuba and its LLVM, these tests are skipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from specimap_core.arrays import Singles
from specimap_core.photos.colour import linear_from_srgb
from specimap_validation.path_traced.optics import Optics
from specimap_validation.path_traced.renderer import renderer_missing
from specimap_validation.phantom import MATERIALS, load_truth, write_phantom
from specimap_validation.phantom.materials import WHITE_CARD
from tests.support.traced_scene import TINY, ink_shift

if TYPE_CHECKING:
    from specimap_validation.path_traced.phantom import TracedPhantom
    from specimap_validation.path_traced.settings import TracedSettings

MISSING = renderer_missing()
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"path-traced phantoms need {MISSING}")

SHIFT_PX = 0.1


def traced(settings: TracedSettings) -> TracedPhantom:
    from specimap_validation.path_traced.phantom import TracedPhantom

    return TracedPhantom(settings)


@pytest.fixture(scope="module")
def plain() -> TracedPhantom:
    return traced(replace(TINY, k1=-0.1, k2=0.05, cube_k1=0.5))


def test_ink_in_a_photo_lies_where_the_truth_projects_it(plain: TracedPhantom) -> None:
    _, photo = next(plain.photos())
    picture = linear_from_srgb(photo)[..., 1].astype(float)
    view = plain.views[0]
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    shifts = []
    for corners in plain.marker_corners:
        seen = view.project(corners)
        # The specimen hides part of a marker behind it.
        eye = view.cam_from_world.centre
        behind = (corners.mean(0)[:2] @ eye[:2]) < 0
        if (seen > 4).all() and (seen < size - 5).all() and not behind:
            shifts.append(ink_shift(picture, view, corners))
    assert len(shifts) >= 2
    assert np.abs(shifts).max() < SHIFT_PX


def test_ink_in_the_cube_lies_where_the_truth_projects_it(plain: TracedPhantom) -> None:
    paper = plain.cube_rendering.image[..., WHITE_CARD].astype(float)
    shifts = [ink_shift(paper, plain.hsi_view, corners) for corners in plain.marker_corners]
    assert np.abs(shifts).max() < SHIFT_PX


def test_the_truth_projects_onto_its_pixels(plain: TracedPhantom) -> None:
    truth = plain.truth
    rows, cols = np.indices(truth.hsi_class.shape)
    seen = truth.hsi_view.project(truth.hsi_xyz.astype(float))
    assert np.abs(seen - np.stack([cols, rows], -1)).max() < 1e-3
    assert set(np.unique(truth.hsi_class)) == {1, 2, 3}
    tissue, materials = truth.hsi_class == 1, truth.abundance
    assert materials.sum(2) == pytest.approx(1, abs=1e-5)
    inner = tissue & np.roll(tissue, 2, 0) & np.roll(tissue, -2, 0) & np.roll(tissue, 2, 1) & np.roll(tissue, -2, 1)
    assert materials[inner][:, MATERIALS.index("tray")].max() < 0.2
    assert materials[truth.hsi_class == 2][:, :4].sum(1).mean() < 0.02


def test_light_is_even_on_the_open_tray_and_dark_under_the_specimen(plain: TracedPhantom) -> None:
    tray = plain.lit.light.tray
    assert tray[:20, :20].mean() == pytest.approx(1, abs=0.1)
    middle = len(tray) // 2
    assert tray[middle, middle].max() < 0.2
    assert plain.lit.light.vertices.min() >= 0


def test_the_wet_coat_shines_on_the_specimen_alone(plain: TracedPhantom) -> None:
    from specimap_validation.path_traced.camera import Coat, take_picture
    from specimap_validation.path_traced.surfaces import Painter

    painter = Painter(plain.lit, np.ones((len(MATERIALS), 1)), (1,), np.ones((len(plain.specimen.vertices), 1)))

    def shine(coat: Coat) -> Singles:
        _, mirrored = take_picture(plain.lit, plain.hsi_view, painter, Optics(), coat, samples=8, seed=1)
        return np.asarray(mirrored.mean(2), np.float32)

    classes = plain.truth.hsi_class
    assert shine(Coat(0.0, 0.0, 0.1)).max() == 0
    wet = shine(Coat(1.0, 0.0, 0.1))
    assert wet[classes == 1].mean() > 10 * wet[classes != 1].mean()
    # A film mirrors a few percent of the room, and of a lamp far more.
    assert 0.005 < np.median(wet[classes == 1]) < 0.1
    assert wet.max() > 0.5
    glossy = shine(Coat(0.0, 1.0, 0.1))
    assert glossy[classes == 2].mean() > 10 * glossy[classes != 2].mean()


@pytest.mark.slow
def test_a_specimen_that_moved_has_its_truth_where_the_photos_show_it() -> None:
    still, moved = traced(TINY), traced(replace(TINY, moved_mm=(1.0, 0.0, 0.0), covered=(2,)))
    there = (still.truth.hsi_class == 1) & (moved.truth.hsi_class == 1)
    # The same pixel sees tissue that lies 1 mm apart in the photos.
    apart = (moved.truth.hsi_xyz - still.truth.hsi_xyz)[there]
    assert np.median(apart[:, 0]) == pytest.approx(-1, abs=0.05)
    centre = np.rint(moved.hsi_view.project(moved.marker_corners[2].mean(0))).astype(int)
    assert moved.truth.hsi_class[centre[1], centre[0]] == 4
    assert still.truth.hsi_class[centre[1], centre[0]] == 2


@pytest.mark.slow
def test_a_seed_repeats_and_the_truth_survives_its_file(tmp_path: Path) -> None:
    settings = replace(TINY, cube_scan="rows", scan_jitter_px=0.2, band_shift_px=0.3, noise=0.01, motion_px=1.0)
    for name in "ab":
        written = write_phantom(traced(settings), tmp_path / name)
    for file in ("rgb/view_000.jpg", "hsi/hsi.raw", "truth.npz"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    read = load_truth(tmp_path / "a")
    np.testing.assert_array_equal(read.hsi_xyz, written.hsi_xyz)
    # The stage is uneven, and the truth's camera is an even one.
    rows = np.indices(read.hsi_class.shape)[0]
    off = (read.hsi_view.project(read.hsi_xyz.astype(float))[..., 1] - rows)[read.hsi_class > 0]
    assert 0.1 < off.std() < 0.3

"""What is stated of a point's error: steps of the surface, the parts' sum, a mesh's standard deviation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Singles
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.refinement import Refined, refine_mesh
from specimap_core.surface.settings import RefineSettings
from specimap_core.surface.uncertainty import (
    AGREEMENT_MM,
    LEAST_SIGMA_MM,
    LEAST_SUPPORT,
    SHARES,
    STEEP_MM,
    STEP_REACH_MM,
    UNSEEN_SIGMA_MM,
    Evidence,
    bend_mm,
    mesh_sigma,
    point_sigma,
    refined_scatter,
    step_height,
    support,
    vertex_scatter,
)
from tests.support.matched_scene import matched

pytestmark = pytest.mark.slow

SHAPE = (24, 30)
SEED = 31


def pixels_of(shape: tuple[int, ...] = SHAPE) -> NDArray[np.uint16]:
    """All pixels of an image, row by row."""
    return np.argwhere(np.ones(shape, bool)).astype(np.uint16)


def steps(z: Singles, pixel_mm: float) -> Singles:
    """Steps of an image of heights."""
    return step_height(pixels_of(z.shape), z.ravel(), pixel_mm).reshape(z.shape)


# ---- steps of the surface -----------------------------------------------------------------------------


@pytest.mark.parametrize(("pixel_mm", "half"), [(0.05, 3), (0.075, 2), (0.15, 1), (0.4, 1)])
def test_a_plane_steps_by_its_slope_over_the_reach(pixel_mm: float, half: int) -> None:
    assert half == max(1, round(STEP_REACH_MM / pixel_mm))
    slope = 0.7
    z = np.broadcast_to(slope * pixel_mm * np.arange(SHAPE[1]), SHAPE).astype(np.float32)
    found = steps(z, pixel_mm)
    inner = found[:, half:-half]
    assert inner == pytest.approx(2 * STEP_REACH_MM * slope, rel=1e-4)
    # At the border half the neighbourhood is missing, and nothing is made up for it.
    assert found[:, 0] == pytest.approx(STEP_REACH_MM * slope, rel=1e-4)


def test_a_level_plane_has_no_steps() -> None:
    assert not steps(np.full(SHAPE, 7.5, np.float32), 0.1).any()


def test_a_cliff_shows_within_the_reach_and_no_farther() -> None:
    z = np.zeros(SHAPE, np.float32)
    z[:, 15:] = -9.0
    found = steps(z, STEP_REACH_MM / 3)
    assert found[:, 12:18] == pytest.approx(9.0)
    assert not found[:, :12].any()
    assert not found[:, 18:].any()


def test_pixels_without_a_point_make_no_step() -> None:
    slope = 0.01
    z = np.broadcast_to(slope * np.arange(SHAPE[1]), SHAPE).astype(np.float32)
    kept = np.random.default_rng(3).random(SHAPE) < 0.4
    kept[4:7, 4:7] = False
    kept[5, 5] = True
    pixels = pixels_of()[kept.ravel()]
    found = step_height(pixels, z[kept], 1.0)
    assert found.max() == pytest.approx(2 * STEP_REACH_MM * slope, rel=1e-4)
    alone = np.flatnonzero((pixels == 5).all(1))
    assert found[alone] == pytest.approx(0.0)


def test_the_order_of_pixels_and_the_level_do_not_matter() -> None:
    rng = np.random.default_rng(4)
    pixels, z = pixels_of(), rng.normal(0, 3, SHAPE[0] * SHAPE[1]).astype(np.float32)
    order = rng.permutation(len(z))
    found = step_height(pixels, z, 0.1)
    assert np.array_equal(step_height(pixels[order], z[order], 0.1), found[order])
    assert step_height(pixels, z + 64, 0.1) == pytest.approx(found, abs=1e-4)


# ---- points -------------------------------------------------------------------------------------------


def test_a_point_adds_its_parts_in_squares() -> None:
    surface, step = np.array([0.03, 0.3], np.float32), np.zeros(2, np.float32)
    assert point_sigma(surface, step, 0.0, 0.0) == pytest.approx(surface, rel=1e-6)
    alone = [
        point_sigma(np.zeros(2, np.float32), np.full(2, 2.5, np.float32), 0.0, 0.0),
        point_sigma(surface, step, 0.0, 0.0),
        point_sigma(np.zeros(2, np.float32), step, 0.04, 0.0),
        point_sigma(np.zeros(2, np.float32), step, 0.0, 0.07),
    ]
    together = point_sigma(surface, np.full(2, 2.5, np.float32), 0.04, 0.07)
    assert together == pytest.approx(np.sqrt(sum(a.astype(float) ** 2 for a in alone)), rel=1e-5)
    assert all((a > 0).all() for a in alone)
    assert together.dtype == np.float32


def test_a_flank_is_no_jump() -> None:
    surface = np.full(3, 0.05, np.float32)
    step = np.array([0.0, STEEP_MM, STEEP_MM + 0.4], np.float32)
    flat, flank, jump = point_sigma(surface, step, 0.0, 0.0).tolist()
    assert flank == pytest.approx(flat)
    assert jump == pytest.approx(np.hypot(0.05, 0.4 * SHARES.of_jump), rel=1e-4)


@pytest.mark.parametrize("part", range(4))
def test_no_part_makes_a_point_surer(part: int) -> None:
    before: np.float32 | None = None
    for value in np.linspace(0, 2, 9) + (STEEP_MM if part == 1 else 0):
        parts = [0.05, 0.3, 0.02, 0.01]
        parts[part] = float(value)
        surface, step = (np.array([p], np.float32) for p in parts[:2])
        now = point_sigma(surface, step, parts[2], parts[3])[0]
        assert before is None or now > before
        before = now


# ---- a mesh -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def after() -> Refined:
    """The scene's mesh, refined as in the pipeline."""
    m = matched(SEED)
    return refine_mesh(m.mesh, m.greys, m.lens, m.poses, m.voxel_mm, RefineSettings(), workers=2, worth=m.worth)


def test_stated_and_true_errors_of_a_mesh_go_together(after: Refined) -> None:
    scene = matched(SEED)
    sigma = mesh_sigma(after, scene.maps, scene.poses, workers=2)
    assert sigma.dtype == np.float32
    assert sigma.min() >= np.float32(LEAST_SIGMA_MM)
    assert sigma.max() <= UNSEEN_SIGMA_MM
    of = after.mesh.vertices[:, 2] > 1.0
    off, stated = np.abs(scene.off_mm(after.mesh)[of]), sigma[of]
    low, high = np.percentile(stated, [25, 75])
    assert np.nanmedian(off[stated <= low]) < np.nanmedian(off[stated >= high])


def test_fewer_views_and_less_agreement_make_a_mesh_less_sure(after: Refined) -> None:
    scene = matched(SEED)
    done = (after.views > 0) & np.isfinite(after.sharpness)
    plain = mesh_sigma(after, scene.maps, scene.poses)
    fewer = replace(after, views=np.where(done, 3, 0).astype(np.uint8))
    all_views = replace(after, views=np.where(done, 16, 0).astype(np.uint8))
    assert (mesh_sigma(fewer, scene.maps, scene.poses) >= mesh_sigma(all_views, scene.maps, scene.poses)).all()
    for doubtful in (
        replace(after, found=after.found & (np.arange(len(done)) % 2 == 0)),
        replace(after, sharpness=after.sharpness / np.float32(2)),
    ):
        louder = mesh_sigma(doubtful, scene.maps, scene.poses)
        assert (louder >= plain).all()
        assert (louder[done] > plain[done]).mean() > 0.9


def test_a_bend_makes_a_mesh_less_sure(after: Refined) -> None:
    """A sphere bends by its edge squared over its radius; a plane not at all."""
    edge, radius = 0.3, 12.0
    x, y = (edge * c.ravel() for c in np.meshgrid(np.arange(-15, 16), np.arange(-15, 16)))
    dome = np.stack([x, y, np.sqrt(radius**2 - x**2 - y**2)], -1).astype(np.float32)
    flat = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    first = (31 * np.arange(30)[:, None] + np.arange(30)).ravel()
    triangles = np.concatenate(
        [np.stack([first, first + 1, first + 31], -1), np.stack([first + 1, first + 32, first + 31], -1)]
    ).astype(np.int32)
    grey = np.zeros((len(x), 3), np.uint8)
    normals = (dome / np.linalg.norm(dome, axis=1, keepdims=True)).astype(np.float32)
    round_mm = bend_mm(Mesh(dome, triangles, normals, grey))
    middle = np.hypot(x, y) < 2
    # Four edges along the grid, two diagonals that are longer by the root of two.
    assert round_mm[middle] == pytest.approx(edge**2 / radius * (4 + 2 * 2) / 6, rel=0.05)
    upright = np.tile(np.array([0, 0, 1], np.float32), (len(x), 1))
    assert bend_mm(Mesh(flat, triangles, upright, grey)) == pytest.approx(0.0, abs=1e-7)
    before = Evidence.of(after, np.full(len(after.views), 0.1, np.float32))
    assert (replace(before, bend=np.zeros_like(before.bend)).sigma() <= before.sigma()).all()


def test_support_is_the_share_of_the_surroundings_that_photos_told(after: Refined) -> None:
    everywhere = replace(after, found=np.isfinite(after.sharpness))
    refined = np.isfinite(after.sharpness)
    assert support(everywhere)[refined] == pytest.approx(1.0, abs=1e-5)
    nowhere = replace(after, found=np.zeros_like(after.found))
    assert support(nowhere) == pytest.approx(LEAST_SUPPORT)
    left = replace(after, found=refined & (after.mesh.vertices[:, 0] < 0))
    share, x = support(left)[refined], after.mesh.vertices[refined, 0]
    assert share[x < -3].min() > 0.95
    assert share[x > 3].max() == pytest.approx(LEAST_SUPPORT, abs=0.05)
    assert 0.3 < np.median(share[np.abs(x) < 0.1]) < 0.7


def test_photos_that_agree_on_nothing_leave_the_scatter_of_the_depths(after: Refined) -> None:
    scene = matched(SEED)
    flat = replace(after, sharpness=np.zeros_like(after.sharpness))
    assert np.array_equal(mesh_sigma(flat, scene.maps, scene.poses), refined_scatter(after, scene.maps, scene.poses))


def test_unrefined_vertices_keep_the_scatter_of_the_depths(after: Refined) -> None:
    scene = matched(SEED)
    idle = after.views == 0
    assert idle.any()
    scatter = refined_scatter(after, scene.maps, scene.poses, workers=2)
    assert mesh_sigma(after, scene.maps, scene.poses)[idle] == pytest.approx(scatter[idle], rel=1e-6)
    # Depths scatter about what was fused of them by a part of a voxel, not by nothing.
    assert 0.01 < np.median(scatter[idle]) < scene.voxel_mm


def test_what_no_depth_map_sees_is_as_good_as_unknown(after: Refined) -> None:
    scene = matched(SEED)
    away = replace(after.mesh, vertices=(after.mesh.vertices + np.float32(3 * AGREEMENT_MM) * after.mesh.normals))
    scatter = vertex_scatter(away, scene.maps[:1], scene.poses)
    assert (scatter == UNSEEN_SIGMA_MM).mean() > 0.9
    assert (vertex_scatter(after.mesh, (), scene.poses) == UNSEEN_SIGMA_MM).all()
    blind = mesh_sigma(after, (), scene.poses)
    assert (blind == UNSEEN_SIGMA_MM).all()

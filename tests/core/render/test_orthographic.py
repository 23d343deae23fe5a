"""Top views of a surface whose height is a formula."""

from __future__ import annotations

import numpy as np
import pytest

from specimap_core.errors import SettingsError
from specimap_core.render.orthographic import extent_of, render_grid
from specimap_core.surface.raycast import RayCaster
from tests.support.scenes import bump_height, bump_mesh

LOW, HIGH = np.array([-20.13, -15.21]), np.array([19.87, 14.79])  # off the mesh's own vertices


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(bump_mesh())


@pytest.mark.parametrize("cell_mm", [2.0, 0.5, 0.05])
def test_cells_hold_the_height_below_their_centre(caster: RayCaster, cell_mm: float) -> None:
    grid = render_grid(caster, LOW, HIGH, cell_mm)
    rows, cols = grid.covered.shape
    assert (rows, cols) == (round(30 / cell_mm) + 1, round(40 / cell_mm) + 1)
    assert grid.covered.all()
    x, y = np.meshgrid(LOW[0] + cell_mm * np.arange(cols), LOW[1] + cell_mm * np.arange(rows))
    assert np.allclose(grid.xyz[..., 0], x, atol=1e-3)
    assert np.allclose(grid.xyz[..., 1], y, atol=1e-3)
    errors = np.abs(grid.xyz[..., 2] - bump_height(x, y))
    assert 1e-6 < errors.max() < 0.02  # the mesh's own cells of half a millimetre
    assert np.allclose(np.linalg.norm(grid.normal, axis=-1), 1, atol=1e-4)
    assert (grid.normal[..., 2] > 0.3).all()


def test_grids_of_two_resolutions_share_their_origin(caster: RayCaster) -> None:
    coarse, fine = (render_grid(caster, LOW, HIGH, cell) for cell in (2.0, 0.5))
    places = np.random.default_rng(0).uniform(LOW, HIGH, (20, 2))
    s = coarse.cell_mm / fine.cell_mm
    assert np.allclose(s * coarse.pixel_of(places), fine.pixel_of(places))
    assert np.allclose(coarse.xyz[::2, ::2], fine.xyz[::8, ::8][: coarse.xyz[::2].shape[0]], atol=1e-4)


def test_cells_beside_the_surface_are_empty(caster: RayCaster) -> None:
    grid = render_grid(caster, np.array([20.0, -5.0]), np.array([40.0, 5.0]), 0.5)
    outside = grid.xyz[..., 0]
    assert 0.45 < grid.covered.mean() < 0.55
    assert np.isnan(outside[~grid.covered]).all()
    assert (grid.image[~grid.covered] == 0).all()


def test_the_colour_is_the_surfaces(caster: RayCaster) -> None:
    grid = render_grid(caster, LOW, HIGH, 0.5)
    expected = 128 + 4 * grid.xyz[..., 0]
    assert np.abs(grid.image[..., 0] - expected).max() < 4
    assert (grid.image[..., 1] == 90).all()


@pytest.mark.parametrize("cell_mm", [0.0, -1.0, float("nan"), 1e-3])
def test_impossible_cells_are_refused(caster: RayCaster, cell_mm: float) -> None:
    with pytest.raises(SettingsError) as refused:
        render_grid(caster, LOW, HIGH, cell_mm)
    assert refused.value.details["setting"] == "r_pc"


def test_the_extent_spans_the_markers() -> None:
    corners = np.random.default_rng(1).uniform(-30, 30, (4, 4, 3))
    low, high = extent_of(corners, 4.0)
    assert np.allclose(low, corners[..., :2].min((0, 1)) - 4)
    assert np.allclose(high, corners[..., :2].max((0, 1)) + 4)


def test_rays_from_far_away_stay_exact() -> None:
    """Embree counts in single precision; a camera at 400 mm must not cost micrometres."""
    caster = RayCaster(bump_mesh())
    eye = np.array([3.0, -2.0, 4000.0])
    targets = np.random.default_rng(2).uniform(-20, 20, (500, 3)) * [1, 1, 0]
    directions = targets - eye
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = caster.cast(eye, directions)
    assert hits.hit.all()
    off_ray = np.linalg.norm(np.cross(hits.xyz - eye, directions), axis=1)
    assert off_ray.max() < 5e-3
    miss = caster.cast(eye, -directions)
    assert not miss.hit.any()
    assert np.isnan(miss.xyz).all()

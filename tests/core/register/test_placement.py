"""The cube's camera and the published homography, on a surface whose height is a formula."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.errors import DuplicateMarkersError, MarkersMissingInCubeError, RegistrationError
from specimap_core.fiducials.detection import dictionary_named
from specimap_core.geometry.cameras import Intrinsics, View, look_at
from specimap_core.register.camera_models import FOCAL_PRIOR_SD
from specimap_core.register.cube_camera import solve_camera
from specimap_core.register.cube_markers import find_markers, stretched
from specimap_core.register.placement import fit_homography, place_by_camera, place_by_homography
from specimap_core.render.orthographic import render_grid
from specimap_core.surface.raycast import RayCaster
from tests.support.scenes import bump_height, bump_mesh

ROWS, COLS = 120, 150
VIEW = View(
    Intrinsics.centred(COLS, ROWS, 1000.0), look_at(np.array([8.0, -6, 400]), np.zeros(3), np.array([0.0, 1, 0]))
)


def layout(lift_mm: float = 0.0, seed: int = 0) -> Floats:
    """Four squares of 6.8 mm around the bump, (4, 4, 3) mm; cards lie up to ``lift_mm`` high."""
    rng = np.random.default_rng(seed)
    half = 3.4 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    places = np.array([[-22, -17, 0], [22, -17, 0], [22, 17, 0], [-22, 17, 0.0]])
    places[:, 2] = rng.uniform(0, lift_mm, 4) if lift_mm else 0
    return np.asarray(places[:, None] + half)


def corners_in_cube(lift_mm: float = 0.0, noise_px: float = 0.03, seed: int = 0) -> tuple[Floats, Floats, Floats]:
    corners = layout(lift_mm, seed).reshape(-1, 3)
    noise = np.random.default_rng(seed + 1).normal(0, noise_px, (len(corners), 2))
    return corners, VIEW.project(corners) + noise, np.full(len(corners), noise_px)


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(bump_mesh())


@pytest.mark.parametrize("lift_mm", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_camera_is_solved_without_calibration(lift_mm: float, seed: int) -> None:
    camera = solve_camera(*corners_in_cube(lift_mm, seed=seed), ROWS, COLS)
    assert 0.005 < camera.rms_px < 0.06
    assert camera.view.cam_from_world.centre[2] > 0
    assert 1e-6 < abs(np.log(camera.view.intrinsics.focal_px / 1000)) < 0.6
    assert 0.001 < camera.focal_sd < FOCAL_PRIOR_SD


def errors_on_surface(xyz: Floats, pixels: Array) -> Floats:
    """Distance, in mm, of points from the ray of the pixel that they belong to, and from the surface."""
    rays = VIEW.world_rays(pixels[:, ::-1].astype(float))
    across = np.linalg.norm(np.cross(xyz - VIEW.cam_from_world.centre, rays), axis=1)
    above = np.abs(xyz[:, 2] - bump_height(xyz[:, 0], xyz[:, 1]))
    return np.asarray(np.hypot(across, above))


def test_the_camera_removes_the_parallax_that_the_homography_leaves(caster: RayCaster) -> None:
    corners, pixels, sigma = corners_in_cube(seed=3)
    camera = solve_camera(corners, pixels, sigma, ROWS, COLS)
    by_camera = place_by_camera(camera.view, caster, False)
    low, high = np.array([-28.0, -23.0]), np.array([28.0, 23.0])
    coarse, fine = (render_grid(caster, low, high, cell) for cell in (2.0, 0.5))
    homography = fit_homography(corners, pixels, coarse, 3.0)
    by_homography = place_by_homography(homography, coarse, fine, camera.view, caster, False)
    on_bump = [p.xyz[:, 2] > 3 for p in (by_camera, by_homography)]
    placed = [
        errors_on_surface(p.xyz.astype(float)[k], p.pixels[k])
        for p, k in zip((by_camera, by_homography), on_bump, strict=True)
    ]
    assert 0.001 < np.median(placed[0]) < 0.06
    assert 0.08 < np.median(placed[1]) < 1.0
    assert homography.inliers.all()
    assert not by_camera.occluded.any()
    assert by_camera.incidence_deg.min() < 5
    assert by_camera.incidence_deg[by_camera.xyz[:, 2] > 3].max() > 30


def test_in_the_plane_both_methods_agree(caster: RayCaster) -> None:
    corners, pixels, sigma = corners_in_cube(seed=4)
    camera = solve_camera(corners, pixels, sigma, ROWS, COLS)
    low, high = np.array([-28.0, -23.0]), np.array([28.0, 23.0])
    coarse, fine = (render_grid(caster, low, high, cell) for cell in (2.0, 0.5))
    homography = fit_homography(corners, pixels, coarse, 3.0)
    placements = [
        place_by_camera(camera.view, caster, False),
        place_by_homography(homography, coarse, fine, camera.view, caster, False),
    ]
    index = np.full((ROWS, COLS), -1)
    index[placements[1].pixels[:, 0], placements[1].pixels[:, 1]] = np.arange(len(placements[1].pixels))
    partner = index[placements[0].pixels[:, 0], placements[0].pixels[:, 1]]
    flat = (placements[0].xyz[:, 2] < 0.02) & (partner >= 0)
    apart = np.linalg.norm(placements[0].xyz[flat] - placements[1].xyz[partner[flat]], axis=1)
    assert 0.001 < np.median(apart) < 0.05


def test_a_mirrored_cube_puts_its_pixels_at_the_same_places(caster: RayCaster) -> None:
    corners, pixels, sigma = corners_in_cube(seed=5)
    camera = solve_camera(corners, pixels, sigma, ROWS, COLS)
    straight, mirrored = (place_by_camera(camera.view, caster, m) for m in (False, True))
    at = {(int(r), int(c)): p for (r, c), p in zip(straight.pixels, straight.xyz, strict=True)}
    for (row, col), xyz in list(zip(mirrored.pixels, mirrored.xyz, strict=True))[::97]:
        assert np.allclose(at[int(row), COLS - 1 - int(col)], xyz)


def test_a_camera_that_looks_elsewhere_is_refused(caster: RayCaster) -> None:
    away = View(VIEW.intrinsics, look_at(np.array([0.0, 0, 400]), np.array([500.0, 0, 400]), np.array([0.0, 0, 1])))
    with pytest.raises(RegistrationError):
        place_by_camera(away, caster, False)
    rng = np.random.default_rng(0)
    behind = VIEW.project(layout().reshape(-1, 3))[:, ::-1] * [1, -1] + rng.normal(0, 30, (16, 2))
    with pytest.raises(RegistrationError):
        fit_homography(np.zeros((16, 3)), behind, render_grid(caster, np.zeros(2), np.ones(2), 1.0), 3.0)


# ---- markers in the cube ------------------------------------------------------------------------------


@dataclass
class MemoryCube:
    """A cube in memory (rows, cols, bands)."""

    values: NDArray[np.float32]

    @property
    def cols(self) -> int:
        return int(self.values.shape[1])

    @property
    def bands(self) -> int:
        return int(self.values.shape[2])

    @property
    def wavelengths_nm(self) -> Floats:
        return np.linspace(400, 1000, self.bands)

    @property
    def bad_bands(self) -> NDArray[np.bool_]:
        return np.zeros(self.bands, bool)

    def band(self, index: int) -> Array:
        return self.values[..., index]

    def mean_image(self, bands: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        chosen = self.values if bands is None else self.values[..., bands]
        finite = np.isfinite(chosen)
        total = np.where(finite, chosen, 0).sum(-1) / np.maximum(finite.sum(-1), 1)
        return np.where(finite.any(-1), total, np.nan).astype(np.float32)


def marker_cube(
    ids: tuple[int, ...] = (0, 1, 2, 3), *, bands: int = 8, shown: slice = slice(None), noise: float = 0.01
) -> MemoryCube:
    """White paper with four markers of 36 pixels that show in the bands ``shown``, and noise."""
    paper = np.full((160, 200, bands), 0.7, np.float32)
    for place, marker_id in zip([(10, 12), (12, 140), (110, 9), (112, 138)], ids, strict=True):
        drawn = cv2.aruco.generateImageMarker(dictionary_named("DICT_4X4_50"), marker_id, 36)
        patch = np.where(drawn > 127, 0.7, 0.04).astype(np.float32)
        paper[place[0] : place[0] + 36, place[1] : place[1] + 36, shown] = patch[..., None]
    return MemoryCube(paper + np.random.default_rng(0).normal(0, noise, paper.shape).astype(np.float32))


def test_markers_are_found_in_the_band_mean() -> None:
    found = find_markers(marker_cube(), "DICT_4X4_50", (0, 1, 2, 3))
    assert (found.marker_ids, found.where, found.mirrored) == ((0, 1, 2, 3), "band mean", False)
    # The square's outline lies half a pixel outside its outermost pixels.
    assert np.allclose(found.corners_px[0], [[11.5, 9.5], [47.5, 9.5], [47.5, 45.5], [11.5, 45.5]], atol=0.1)


def test_markers_that_show_in_some_bands_only_are_found_there() -> None:
    cube = marker_cube(bands=24, shown=slice(4, 5), noise=0.08)
    found = find_markers(cube, "DICT_4X4_50", (0, 1, 2, 3))
    assert found.marker_ids == (0, 1, 2, 3)
    assert "nm" in found.where


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_cube_is_no_trouble(turns: int) -> None:
    cube = MemoryCube(np.ascontiguousarray(np.rot90(marker_cube().values, turns)))
    assert find_markers(cube, "DICT_4X4_50", (0, 1, 2, 3)).marker_ids == (0, 1, 2, 3)


def test_a_mirrored_cube_is_recognised() -> None:
    straight = find_markers(marker_cube(), "DICT_4X4_50", (0, 1, 2, 3))
    for flipped, axis in ((np.fliplr, 0), (np.flipud, 1)):
        found = find_markers(MemoryCube(flipped(marker_cube().values).copy()), "DICT_4X4_50", (0, 1, 2, 3))
        assert found.mirrored
        assert found.marker_ids == (0, 1, 2, 3)
        expected = straight.corners_px.copy()
        expected[..., axis] = (199, 159)[axis] - expected[..., axis]
        assert np.abs(found.corners_px - expected).max() < 0.1


def test_lost_pixels_do_not_hide_markers() -> None:
    cube = marker_cube()
    rng = np.random.default_rng(1)
    cube.values[rng.integers(0, 160, 400), rng.integers(0, 200, 400)] = np.nan
    assert len(find_markers(cube, "DICT_4X4_50", (0, 1, 2, 3)).marker_ids) == 4


def test_unknown_ids_are_passed_over_and_too_few_refused() -> None:
    assert find_markers(marker_cube((0, 1, 7, 9)), "DICT_4X4_50", (0, 1, 2, 3)).marker_ids == (0, 1)
    with pytest.raises(MarkersMissingInCubeError) as refused:
        find_markers(marker_cube((0, 6, 7, 9)), "DICT_4X4_50", (0, 1, 2, 3))
    assert refused.value.details == {"seen": [0], "wanted": [0, 1, 2, 3]}


def test_one_id_twice_is_refused() -> None:
    with pytest.raises(DuplicateMarkersError) as refused:
        find_markers(marker_cube((0, 1, 2, 2)), "DICT_4X4_50", (0, 1, 2))
    assert refused.value.details["ids"] == [2]


def test_stretching_takes_anything() -> None:
    for image in (np.full((4, 4), np.nan), np.zeros((4, 4)), np.array([[np.inf, 1], [2, np.nan]])):
        assert stretched(image.astype(np.float32)).dtype == np.uint8

"""A network's depth brought to millimetres: scale, shift, outliers; photos as the network sees them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from specimap_core.arrays import Singles
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at
from specimap_core.reconstruct.backends.da3.backend import Metric, in_millimetres, maps_of, smooth_surface
from specimap_core.reconstruct.backends.da3.prepare import conditioning, plan_preparation, windows
from specimap_core.reconstruct.backends.da3.residual_field import correct_residuals
from specimap_core.reconstruct.backends.depth_alignment import align, depths_at, on_markers
from specimap_core.reconstruct.dense.cross_check import confirmed, nearest_photos
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_validation.phantom import Phantom
from tests.support.scenes import SMALL, OnDisk
from tests.support.true_depth import true_depth


class Exact:
    """The small phantom's photos with their exact depth, and known places on its surface and markers."""

    def __init__(self, small: OnDisk) -> None:
        self.truth = small.truth
        self.views = small.truth.views
        scene = Phantom(SMALL).scene
        self.depth = np.stack([true_depth(scene, v) for v in self.views])
        rng = np.random.default_rng(0)
        rows, cols = (rng.integers(60, SMALL.photo_size - 60, 150) for _ in range(2))
        rays = self.views[0].intrinsics.rays(np.stack([cols, rows], -1).astype(float))
        places = self.views[0].cam_from_world.inverse().apply(rays * self.depth[0][rows, cols, None])
        markers = np.arange(len(self.truth.marker_ids))
        seen = Observations(np.zeros(len(markers), int), markers, np.zeros((len(markers), 4, 2)), np.ones(len(markers)))
        self.known = np.concatenate([on_markers(self.truth.marker_corners, seen, 0), places])


@pytest.fixture(scope="module")
def exact(small: OnDisk) -> Exact:
    return Exact(small)


# ---- alignment ----------------------------------------------------------------------------------------


def test_markers_known_places_lie_on_the_markers(exact: Exact) -> None:
    _, found, true = depths_at(exact.known[:144], exact.views[0], exact.depth[0])
    assert len(found) == 144
    # Interpolated between pixels 0.15 mm apart on cards seen at 45 degrees; the card is one plane, so exact but for
    # float32 and curvature of depth over a pixel.
    assert 0 < np.abs(found - true).max() < 0.02


@pytest.mark.parametrize("scale", [0.004, 1.0, 37.0])
def test_a_scale_is_recovered_from_noise_and_outliers(exact: Exact, scale: float) -> None:
    rng = np.random.default_rng(1)
    network = exact.depth[0] / np.float32(scale) * (1 + 0.004 * rng.standard_normal(exact.depth[0].shape))
    _, found, true = depths_at(exact.known, exact.views[0], network.astype(np.float32))
    wrong = rng.random(len(found)) < 0.3
    found[wrong] *= rng.uniform(0.7, 1.4, int(wrong.sum()))
    fit = align(found, true)
    assert fit is not None
    assert fit.b == 0
    # About 200 places that scatter by up to 0.4 % (interpolation averages) leave the scale open by 0.03 %.
    assert 1e-7 < abs(fit.a * scale - 1) < 0.001
    assert 0.0015 < fit.scatter < 0.0045
    assert 0.6 * fit.of < fit.places <= fit.of


def test_a_shift_of_the_inverse_is_recovered_where_there_is_one(exact: Exact) -> None:
    rng = np.random.default_rng(2)
    z = exact.depth[0].astype(float)
    # 1 / z = a / d + b with b a fifth of 1 / z.
    a, b = 0.02, 0.2 / 150
    network = a / (1 / z - b) * (1 + 0.001 * rng.standard_normal(z.shape))
    _, found, true = depths_at(exact.known, exact.views[0], network.astype(np.float32))
    wrong = rng.random(len(found)) < 0.2
    found[wrong] *= rng.uniform(0.8, 1.25, int(wrong.sum()))
    fit = align(found, true)
    assert fit is not None
    assert fit.b != 0
    off = np.abs(fit.apply(network.astype(np.float32)) / z - 1)
    # The noise itself is 0.1 %; between the known depths the fit adds less than that.
    assert 0.0002 < np.median(off) < 0.0015
    scaled = np.median(z / network) * network
    assert np.median(np.abs(scaled / z - 1)) > 2 * np.median(off)


def test_no_shift_is_made_up(exact: Exact) -> None:
    rng = np.random.default_rng(3)
    _, found, true = depths_at(exact.known, exact.views[0], exact.depth[0])
    for _ in range(5):
        fit = align(found * (1 + 0.01 * rng.standard_normal(len(found))), true)
        assert fit is not None
        assert fit.b == 0


def test_depth_that_fits_nothing_is_refused(exact: Exact) -> None:
    rng = np.random.default_rng(4)
    _, found, true = depths_at(exact.known, exact.views[0], exact.depth[0])
    assert align(rng.uniform(0.5, 2, len(found)), true) is None
    assert align(true.max() + true.min() - found, true) is None  # near and far exchanged
    assert align(np.full(len(found), 1.0), true) is None  # a flat guess
    assert align(found[:8], true[:8]) is None
    assert align(np.full(len(found), np.nan), true) is None
    assert align(np.zeros(len(found)), true) is None
    assert align(found, true) is not None
    assert depths_at(exact.known - [0, 0, 1000.0], exact.views[0], exact.depth[0])[1].shape == (0,)


def test_what_changes_slowly_is_taken_off_where_places_are_known(exact: Exact) -> None:
    depth = exact.depth[0]
    rng = np.random.default_rng(5)
    wave = gaussian_filter(rng.standard_normal(depth.shape), 40)
    wrong = (depth * (1 + 0.01 * wave / wave.std())).astype(np.float32)
    rows, cols = (rng.integers(0, SMALL.photo_size, 1500) for _ in range(2))
    cols = cols // 2  # the left half alone
    true = depth[rows, cols] * (1 + 0.002 * rng.standard_normal(len(rows)))
    true[::10] *= 1.2  # false matches
    bent, scatter = correct_residuals(wrong, np.stack([cols, rows], -1).astype(float), true)
    left, right = np.s_[:, 10:180], np.s_[:, 260:]

    def off(found: Singles, part: tuple[slice, slice]) -> float:
        return float(np.sqrt(np.mean((found / depth - 1)[part] ** 2)))

    # The error turns over 40 pixels, the kernel reaches 10. Some twelve places within reach, against three of doubt,
    # leave a fifth of it; their scatter of 0.2 % adds a twentieth.
    assert 0.0005 < off(bent, left) < 0.35 * off(wrong, left)
    assert off(bent, right) == pytest.approx(off(wrong, right), rel=0.05)
    assert 0.001 < scatter < 0.004
    nowhere, infinite = correct_residuals(wrong, np.zeros((0, 2)), np.zeros(0))
    assert np.array_equal(nowhere, wrong)
    assert infinite == np.inf


def test_a_view_comes_to_millimetres(exact: Exact) -> None:
    noise = np.random.default_rng(6).standard_normal(exact.depth[0].shape)
    network = (exact.depth[0] / 30 * (1 + 0.002 * noise)).astype(np.float32)
    found = in_millimetres(exact.known, exact.views[0], network, 0)
    assert found is not None
    # The noise itself: the median of 0.2 % is 0.13 %.
    assert 0.0010 < np.median(np.abs(found.depth / exact.depth[0] - 1)) < 0.0016
    assert in_millimetres(exact.known, exact.views[0], np.ones_like(exact.depth[0]), 0) is None


# ---- what becomes of the depth ------------------------------------------------------------------------


def test_edges_are_left_out_and_slopes_kept() -> None:
    view = View(Intrinsics.centred(120, 100, 200.0), Pose(np.eye(3), np.zeros(3)))
    depth = np.full((100, 120), 100.0, np.float32)
    depth[:, 60:] = 112  # a step of 24 pixel widths
    kept = smooth_surface(depth, view)
    assert not kept[:, 59:61].any()
    assert (kept[:, :58] == 100).all()
    assert (kept[:, 62:] == 112).all()
    sloped = (100 + 2.5 * np.arange(120)[None] * np.ones((100, 1))).astype(np.float32)  # 5 pixel widths a pixel
    assert (smooth_surface(sloped, view) > 0).all()


def test_maps_lie_in_the_volume_and_leave_out_what_others_contradict(exact: Exact) -> None:
    volume = volume_over(exact.truth.marker_corners)
    lens = exact.views[0].intrinsics
    depth = exact.depth.copy()
    depth[2, 150:200, 150:200] *= 0.93  # one view alone sees a block 10 mm too near
    metric: list[Metric | None] = [Metric(d, 0.002) for d in depth]
    metric[5] = None
    maps = maps_of(np.zeros((*depth.shape, 3), np.uint8), exact.views, metric, volume, 2)
    assert [m.photo for m in maps] == [k for k in range(len(depth)) if k != 5]
    for m in maps:
        points = m.points(exact.views[m.photo].cam_from_world)
        assert (points > volume.low - 1e-3).all()
        assert (points < volume.high + 1e-3).all()
        assert ((m.confidence > 0) == (m.depth > 0)).all()
        left, top = round(lens.cx - m.intrinsics.cx), round(lens.cy - m.intrinsics.cy)
        height, width = m.depth.shape
        off = np.abs(m.depth - exact.depth[m.photo, top : top + height, left : left + width])[m.depth > 0]
        assert np.percentile(off, 99) < 0.1


def test_confirmation_counts_who_sees_and_who_agrees(exact: Exact) -> None:
    views, depth = exact.views[:4], list(exact.depth[:4].copy())
    depth[0] = depth[0].copy()
    depth[0][180:220, 180:220] *= np.float32(0.97)
    others = nearest_photos([v.cam_from_world for v in views], np.zeros(3), 3)
    seen, agreed = confirmed(depth, views, others, 0.005, workers=2)[0]
    assert (agreed <= seen).all()
    assert seen.max() == 3
    assert agreed[182:218, 182:218].mean() < 0.1
    assert agreed[100:150, 150:250].mean() > 1.5


# ---- preparation --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "height", "size_px"), [(512, 512, 504), (1280, 960, 504), (300, 533, 504), (640, 480, 980)]
)
def test_photos_become_whole_patches_of_square_pixels(width: int, height: int, size_px: int) -> None:
    lens = Intrinsics.centred(width, height, 1.1 * width)
    plan = plan_preparation(lens, size_px)
    assert max(plan.size) == size_px
    assert all(v % 14 == 0 for v in plan.size)
    assert abs(plan.size[0] / plan.size[1] - width / height) < 14 / min(plan.size)
    pixels = np.random.default_rng(0).uniform(0, [width, height], (50, 2))
    assert np.abs(plan.to_photo(plan.to_network(pixels)) - pixels).max() < 1e-9
    # The same ray, told by photo and by network image.
    assert np.abs(plan.intrinsics.rays(plan.to_network(pixels)) - lens.rays(pixels)).max() < 1e-9
    middle = plan.to_network(np.array([(width - 1) / 2, (height - 1) / 2]))
    assert np.abs(middle + 0.5 - np.array(plan.size) / 2).max() < 1e-6


@pytest.mark.parametrize(("photo", "size_px"), [((200, 200), 196), ((240, 180), 112), ((120, 160), 266)])
def test_the_image_lies_where_the_map_says_to_a_hundredth_of_a_pixel(photo: tuple[int, int], size_px: int) -> None:
    lens = Intrinsics.centred(*photo, 250.0)
    plan = plan_preparation(lens, size_px)
    # A ramp tells each pixel's place in the photo; the rounding to 8 bits averages out over the image.
    x, y = np.meshgrid(np.arange(photo[0]), np.arange(photo[1]))
    ramp = np.stack([x + 8, y + 8, np.zeros_like(x)], -1).astype(np.uint8)
    shown = plan.apply(ramp).astype(float)
    assert shown.shape == (plan.size[1], plan.size[0], 3)
    u, v = np.meshgrid(np.arange(plan.size[0]), np.arange(plan.size[1]))
    output = plan.to_photo(np.stack([u, v], -1).astype(float))
    inner = np.s_[8:-8, 8:-8]
    for axis in (0, 1):
        off = (shown[..., axis] - 8 - output[..., axis])[inner]
        assert abs(off.mean()) * plan.scale < 0.01
        assert 1e-6 < np.abs(off).max() <= 1.1


def test_distortion_is_undone() -> None:
    lens = Intrinsics(240, 200, 260.0, 121.0, 98.0, 0.12, -0.03)
    plan = plan_preparation(lens, 238)
    at = np.array([215.3, 30.6])
    y, x = np.mgrid[:200, :240]
    dot = np.asarray(255 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 18), np.uint8)
    weight = plan.apply(np.repeat(dot[..., None], 3, 2))[..., 0].astype(float)
    v, u = np.mgrid[: plan.size[1], : plan.size[0]]
    centre = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    expected = plan.intrinsics.project(lens.rays(at))
    assert np.linalg.norm(centre - expected) < 0.05
    assert np.linalg.norm(plan.to_network(at) - expected) > 1


# ---- photos that go together --------------------------------------------------------------------------


def ring(count: int) -> tuple[Pose, ...]:
    azimuths = np.random.default_rng(0).permutation(count) * 2 * np.pi / count
    eyes = [150 * np.array([0.6 * np.cos(a), 0.6 * np.sin(a), 0.8]) for a in azimuths]
    return tuple(look_at(eye, np.zeros(3), np.array([0.0, 0, 1])) for eye in eyes)


@pytest.mark.parametrize(("photos", "most", "sizes"), [(24, 12, {12}), (25, 12, {8, 9}), (5, 12, {5}), (7, 1, {1})])
def test_windows_hold_neighbours_and_every_photo_once(photos: int, most: int, sizes: set[int]) -> None:
    poses = ring(photos)
    found = windows(poses, np.zeros(3), most)
    assert {len(w) for w in found} == sizes
    assert sorted(k for w in found for k in w) == list(range(photos))
    for window in found:
        azimuth = np.unwrap([np.arctan2(*poses[k].centre[1::-1]) for k in window])
        assert np.ptp(azimuth) <= 2 * np.pi * len(window) / photos


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_the_network_gets_poses_about_the_first_at_unit_distance(count: int) -> None:
    poses = list(ring(9)[:count])
    given = conditioning(poses)
    assert np.allclose(given[0], np.eye(4), atol=1e-12)
    distances = [float(np.linalg.norm(np.linalg.inv(g)[:3, 3])) for g in given]
    if count > 1:
        true = [float(np.linalg.norm(p.centre - poses[0].centre)) for p in poses]
        factor = distances[-1] / true[-1]
        assert np.allclose(distances, np.array(true) * factor)
        assert any(abs(d - 1) < 1e-9 for d in distances)
    for g, pose in zip(given, poses, strict=True):
        assert np.allclose(g[:3, :3], pose.R @ poses[0].R.T)


def test_depth_of_the_network_image_is_depth_of_the_photo(exact: Exact) -> None:
    """Depth at the network's pixels, cast from its own camera, lies on the surface that the photo's camera sees."""
    view = View(plan_preparation(exact.views[0].intrinsics, 252).intrinsics, exact.views[0].cam_from_world)
    depth = true_depth(Phantom(SMALL).scene, view)
    rays = view.intrinsics.rays(np.stack(np.meshgrid(np.arange(252), np.arange(252)), -1).astype(float))
    at = np.rint(exact.views[0].intrinsics.project(rays * depth[..., None])).astype(int)
    inner = np.s_[4:-4, 4:-4]
    off = np.abs(exact.depth[0][at[..., 1], at[..., 0]] - depth)[inner]
    # The nearest photo pixel lies up to half a pixel, 0.1 mm, off, on surfaces seen at 45 degrees.
    assert 1e-4 < np.median(off) < 0.1

"""Photos located by their features against photos whose poses are known."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from specimap_core.geometry.cameras import Intrinsics, View, look_at
from specimap_core.geometry.colmap_cameras import colmap_camera
from specimap_core.geometry.triangulation import triangulate_pair
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photos
from specimap_core.reconstruct.features.sift import Sift, extract, match
from specimap_core.reconstruct.resection import Locator
from tests.support.scenes import OnDisk, rotation_deg

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("remembered_sift")]

TARGET = np.array([0.0, 0.0, 3.0])


@pytest.fixture(scope="module")
def photos(small: OnDisk) -> list[Photo]:
    return read_photos(photo_paths(small.photos), AcquisitionSettings())[0]


def test_extraction_repeats_and_counts_from_pixel_centres(photos: list[Photo]) -> None:
    first, again = extract(photos[0]), extract(photos[0])
    assert len(first.xy) > 200
    assert np.array_equal(first.xy, again.xy)
    assert np.array_equal(first.descriptors, again.descriptors)
    assert np.allclose(np.linalg.norm(first.descriptors, axis=1), 1, atol=1e-5)
    # A dot of light whose centre of mass is known tells the pixel convention.
    y, x = np.mgrid[:64, :80]
    dot = np.asarray(255 * np.exp(-((x - 37.0) ** 2 + (y - 29.0) ** 2) / 18), np.uint8)
    photo = Photo("dot", np.repeat(dot[..., None], 3, 2), (80, 64), None, None, 1.0, "")
    assert np.linalg.norm(extract(photo).xy - [37.0, 29.0], axis=1).min() < 0.15


def test_matches_agree_with_the_true_cameras(photos: list[Photo], small: OnDisk) -> None:
    views = small.truth.views
    a, b = 0, 1
    features = [extract(photos[k]) for k in (a, b)]
    pairs = match(*features)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    xy = features[0].xy[pairs[:, 0]], features[1].xy[pairs[:, 1]]
    poses = views[a].cam_from_world, views[b].cam_from_world
    points, good = triangulate_pair(views[a].intrinsics, poses, xy)
    assert good.sum() > 20
    extent = np.abs(points[good][:, :2]).max(1)
    assert np.median(points[good][:, 2]) == pytest.approx(5, abs=6)
    assert np.median(extent) < 40


def test_matching_nothing_gives_nothing(photos: list[Photo]) -> None:
    blank = Photo("blank", np.full((64, 64, 3), 90, np.uint8), (64, 64), None, None, 0.0, "")
    nothing = extract(blank)
    assert match(nothing, extract(photos[0])).shape == (0, 2)


def test_triangulation_is_exact_and_refuses_what_does_not_meet() -> None:
    lens = Intrinsics.centred(640, 480, 800.0, 0.05)
    views = [
        View(lens, look_at(np.array(eye), np.zeros(3), np.array([0.0, 0, 1])))
        for eye in ([80.0, 0, 120], [60.0, 50, 120])
    ]
    points = np.random.default_rng(0).uniform(-10, 10, (30, 3))
    xy = tuple(v.project(points) for v in views)
    found, good = triangulate_pair(lens, (views[0].cam_from_world, views[1].cam_from_world), (xy[0], xy[1]))
    assert good.all()
    assert np.allclose(found, points, atol=1e-4)
    off = xy[1] + np.random.default_rng(1).choice([-1, 1], (30, 2)) * 25
    _, good = triangulate_pair(lens, (views[0].cam_from_world, views[1].cam_from_world), (xy[0], off))
    assert good.mean() < 0.2


def test_colmaps_camera_is_half_a_pixel_on() -> None:
    lens = Intrinsics(640, 480, 800.0, 319.5, 239.5, 0.05, -0.01)
    camera = colmap_camera(lens)
    assert camera.params.tolist() == [800.0, 320.0, 240.0, 0.05, -0.01]
    point = np.array([3.0, -2.0, 100.0])
    assert np.allclose(camera.img_from_cam(point[None])[0] - 0.5, lens.project(point))


def test_a_photo_without_a_pose_is_located(photos: list[Photo], small: OnDisk) -> None:
    views = small.truth.views
    photo = 6
    poses = {k: v.cam_from_world for k, v in enumerate(views) if k != photo}
    answer = Locator(photos, views[0].intrinsics, poses, TARGET, 0, Sift(2)).locate(photo)
    assert answer is not None
    true = views[photo].cam_from_world
    assert 1e-3 < rotation_deg(answer.pose, true) < 3
    assert np.linalg.norm(answer.pose.centre - true.centre) < 8  # of 150 mm


def test_stopping_is_heard_between_photos(photos: list[Photo], small: OnDisk) -> None:
    class StopError(Exception):
        pass

    steps = 0

    def tick() -> None:
        nonlocal steps
        steps += 1
        if steps == 3:
            raise StopError

    views = small.truth.views
    poses = {k: v.cam_from_world for k, v in enumerate(views) if k != 6}
    before = threading.active_count()
    with pytest.raises(StopError):
        Locator(photos, views[0].intrinsics, poses, TARGET, 0, Sift(2), tick).locate(6)
    assert steps == 3
    assert threading.active_count() == before


def test_a_photo_of_something_else_is_not_located(photos: list[Photo], small: OnDisk) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, photos[0].image.shape, dtype=np.uint8)
    strange = [*photos, Photo("noise", noise, photos[0].full_size, None, None, 1.0, "n")]
    views = small.truth.views
    poses = {k: v.cam_from_world for k, v in enumerate(views)}
    assert Locator(strange, views[0].intrinsics, poses, TARGET, 0, Sift(2)).locate(len(photos)) is None

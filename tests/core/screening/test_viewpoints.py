"""From where photos were taken, against the truth of phantoms; and what no photo of a scene gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.fiducials.layout import marker_frame
from specimap_core.fiducials.observations import square_corners
from specimap_core.geometry.cameras import Intrinsics, look_at
from specimap_core.screening.dome import RINGS, direction, dome_of
from specimap_core.screening.photo import Others, judge_photo
from specimap_core.screening.viewpoints import JOINT_PHOTOS, MarkersSeen, Viewpoint, Views, measured_views
from tests.support.places import SAMPLES

EDGE = 6.8
SAMPLE_DEG, HARD_DEG = 0.3, 1.0
"""Measured: 0.05 and 0.57 degrees. A turn of the sample's cameras by twice the bound must not pass."""


def seen_in(folder: Path) -> list[MarkersSeen]:
    shown = []
    for path in sorted(folder.glob("*.jpg")):
        facts = judge_photo(path, "DICT_4X4_50", Others()).facts
        corners = {marker["id"]: np.array(marker["corners"], float) for marker in facts["markers"]}
        shown.append(MarkersSeen((facts["width"], facts["height"]), corners))
    return shown


def true_centres(path: Path) -> Floats:
    """Centres (N, 3) of the cameras in the marker frame."""
    with np.load(path) as truth:
        centres = np.array([-R.T @ t for R, t in zip(truth["rgb_R"], truth["rgb_t"], strict=True)])
        corners = truth["marker_corners"][np.argsort(truth["marker_ids"])]
    return np.asarray(marker_frame(corners, centres).apply(centres))


def largest_error(views: Views, centres: Floats) -> tuple[float, float]:
    """Of the direction in degrees, and of the distance as a share."""
    angles, shares = [], []
    for photo, view in views.viewpoints.items():
        distance = float(np.linalg.norm(centres[photo]))
        toward = direction(view.azimuth_deg, view.elevation_deg) @ centres[photo] / distance
        angles.append(float(np.degrees(np.arccos(np.clip(toward, -1, 1)))))
        shares.append(abs(view.distance_mm / distance - 1))
    return max(angles), max(shares)


@pytest.fixture(scope="module")
def sample() -> list[MarkersSeen]:
    return seen_in(SAMPLES / "rgb")


@pytest.mark.parametrize("count", [1, 2, 4, 24])
def test_directions_of_the_sample(sample: list[MarkersSeen], count: int) -> None:
    views, centres = measured_views(sample[:count], EDGE), true_centres(SAMPLES / "truth.npz")
    assert list(views.viewpoints) == list(range(count))
    angle, share = largest_error(views, centres)
    assert angle < (SAMPLE_DEG if count > 1 else 1.0)
    assert share < 0.01
    c, s = np.cos(np.radians(4 * SAMPLE_DEG)), np.sin(np.radians(4 * SAMPLE_DEG))
    assert largest_error(views, centres @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))[0] > SAMPLE_DEG
    assert list(views.markers) == [0, 1, 2, 3]


def test_directions_where_cards_are_tilted_and_the_lens_distorts(data_dir: Path) -> None:
    folder = data_dir / "phantom_hard"
    shown = seen_in(folder / "rgb")
    views = measured_views(shown, EDGE)
    assert len(views.viewpoints) >= 25
    angle, share = largest_error(views, true_centres(folder / "truth.npz"))
    assert 0.05 < angle < HARD_DEG
    assert share < 0.02


def test_many_photos_are_placed_by_the_layout_of_some(sample: list[MarkersSeen]) -> None:
    many = [photo for _ in range(3) for photo in sample]
    assert len(many) > JOINT_PHOTOS
    views = measured_views(many, EDGE)
    assert len(views.viewpoints) == len(many)
    assert largest_error(views, np.tile(true_centres(SAMPLES / "truth.npz"), (3, 1)))[0] < 2.0


def test_upright_and_smaller_photos_share_a_lens(sample: list[MarkersSeen]) -> None:
    mixed = [
        MarkersSeen((1024, 1024), {m: (px + 0.5) * 2 - 0.5 for m, px in photo.corners.items()}) if k % 2 else photo
        for k, photo in enumerate(sample)
    ]
    assert largest_error(measured_views(mixed, EDGE), true_centres(SAMPLES / "truth.npz"))[0] < SAMPLE_DEG


def test_a_photo_of_another_scene_has_no_place(sample: list[MarkersSeen]) -> None:
    moved = {marker: px + (60.0 if marker == 2 else 0.0) for marker, px in sample[5].corners.items()}
    strange = [*sample[:5], MarkersSeen(sample[5].size, moved), *sample[6:12]]
    views = measured_views(strange, EDGE)
    assert sorted(views.viewpoints) == [k for k in range(12) if k != 5]
    assert largest_error(views, true_centres(SAMPLES / "truth.npz"))[0] < SAMPLE_DEG


def test_photos_of_one_marker_or_none_have_no_place(sample: list[MarkersSeen]) -> None:
    one = MarkersSeen(sample[1].size, {1: sample[1].corners[1]})
    views = measured_views([sample[0], one, MarkersSeen((512, 512), {}), sample[2]], EDGE)
    assert sorted(views.viewpoints) == [0, 3]
    assert measured_views([one], EDGE) == Views({}, {})
    assert measured_views([], EDGE) == Views({}, {})


@pytest.mark.filterwarnings("error")
def test_nonsense_places_nothing_and_breaks_nothing() -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        shown = []
        for _ in range(rng.integers(1, 7)):
            squares = (
                rng.uniform(-(2**17), 2**17, (4, 2)),
                np.zeros((4, 2)),
                np.array([[0, 0], [1e5, 0], [1e5, 1e-3], [0, 1e-3]]),
                np.array([[0, 0], [90, 0], [90, 90], [0, 90.0]]) + rng.normal(0, 30, (4, 2)),
            )
            corners = {int(m): squares[rng.integers(4)] for m in rng.choice(9, rng.integers(6), replace=False)}
            shown.append(MarkersSeen((int(rng.integers(1, 5000)), int(rng.integers(1, 5000))), corners))
        for view in measured_views(shown, EDGE).viewpoints.values():
            assert np.isfinite([view.azimuth_deg, view.elevation_deg, view.distance_mm]).all()


def test_straight_down_alone_still_gives_a_place() -> None:
    lens = Intrinsics.centred(1000, 1000, 900.0)
    pose = look_at(np.array([0, 0, 200.0]), np.zeros(3), np.array([0, 1.0, 0]))
    places = {0: (30, 0, 0), 1: (-30, 0, 0), 2: (0, 30, 0)}
    corners = {m: lens.project(pose.apply(square_corners(10.0) + np.array(at))) for m, at in places.items()}
    (view,) = measured_views([MarkersSeen((1000, 1000), corners)], 10.0).viewpoints.values()
    assert view.elevation_deg > 75


# ---- the dome -----------------------------------------------------------------------------------------


def at(azimuth: float, elevation: float) -> Viewpoint:
    return Viewpoint(azimuth, elevation, 200.0)


def test_dome_of_no_photos() -> None:
    dome = dome_of([])
    assert (dome.covered, dome.enough, len(dome.cells)) == (0, False, sum(count for *_, count in RINGS))
    assert dome.next is not None
    assert dome.next.gap_deg is None


def test_dome_fills_as_one_follows_it() -> None:
    views: list[Viewpoint] = []
    ways = []
    while (dome := dome_of(views)).next is not None:
        here = at(dome.next.azimuth_deg, dome.next.elevation_deg)
        if views:
            toward = direction(views[-1].azimuth_deg, views[-1].elevation_deg)
            ways.append(np.degrees(np.arccos(np.clip(toward @ direction(here.azimuth_deg, here.elevation_deg), -1, 1))))
        views.append(here)
        assert dome_of(views).covered > dome.covered
    assert dome.enough
    assert dome.covered == 1
    assert len(views) <= 22
    # One walks around and does not run across the table.
    assert np.median(ways) < 40


def test_the_sample_fills_the_dome_and_half_of_it_does_not(sample: list[MarkersSeen]) -> None:
    views = list(measured_views(sample, EDGE).viewpoints.values())
    assert dome_of(views).enough
    assert dome_of(views).covered > 0.95
    half = dome_of([view for view in views if view.azimuth_deg > 0])
    assert half.covered < 0.75
    assert not half.enough
    assert half.next is not None
    assert half.next.azimuth_deg < 0


def test_straight_from_above_is_in_the_dome() -> None:
    assert dome_of([at(0, 90)]).covered > 0


def test_twenty_photos_over_nine_tenths_are_enough_and_nineteen_are_not() -> None:
    around = [at(a, e) for _, _, e, count in RINGS for a in np.arange(count) * 360 / count + 180 / count - 180][1:]
    assert len(around) == 21
    gapped = dome_of(around)
    assert 0.9 <= gapped.covered < 1
    assert gapped.enough
    fewer = dome_of(around[:11] + around[13:])
    assert len(around[:11] + around[13:]) == 19
    assert not fewer.enough

"""How a photo becomes what the network sees, what the settings say, and how upstream's failures are told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.errors import DepthNotFoundError, PhotosNotConnectedError, SettingsError
from specimap_core.reconstruct.backends.mast3r.child import STEPS, TypedFailures, bars, require_finite
from specimap_core.reconstruct.backends.mast3r.images import plan_preparation
from specimap_core.reconstruct.backends.mast3r.metric import network_lens
from specimap_core.reconstruct.backends.mast3r.settings import VARIABLES, Mast3rSettings, settings_from_environment

SIZES = [
    (512, 512),
    (1280, 1280),
    (1280, 960),
    (960, 1280),
    (1280, 853),
    (1280, 720),
    (640, 480),
    (300, 200),
    (1279, 961),
]

# ---- photo to network ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_sizes_are_whole_patches_and_squares_stay_whole(size: tuple[int, int]) -> None:
    plan = plan_preparation(size, 512)
    assert max(plan.resized) == max(plan.size) == 512
    assert all(v % 16 == 0 and 0 <= r - v < 17 for v, r in zip(plan.size, plan.resized, strict=True))
    assert (plan.size == (512, 512)) == (size[0] == size[1])


@pytest.mark.parametrize("size", SIZES)
def test_pixels_go_there_and_back(size: tuple[int, int]) -> None:
    plan = plan_preparation(size, 512)
    pixels = np.random.default_rng(0).uniform(0, min(size), (50, 2))
    assert np.abs(plan.to_photo(plan.to_network(pixels)) - pixels).max() < 1e-9
    # The first corner of the photo's first pixel is the first corner of the resized image.
    assert plan.to_network(np.array([-0.5, -0.5])) == pytest.approx([-0.5 - plan.left, -0.5 - plan.top])


def spots(size: tuple[int, int], places: Floats, sigma: float) -> NDArray[np.uint8]:
    """A dark image with soft round spots, whose centroids resizing keeps."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    image = np.zeros(size[::-1])
    for px, py in places:
        image += 250 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * sigma**2))
    return np.repeat(np.round(image).astype(np.uint8)[..., None], 3, axis=2)


def centroid(image: NDArray[np.uint8], near: Floats, reach: int) -> Floats:
    col, row = (round(float(v)) for v in near)
    part = image[row - reach : row + reach + 1, col - reach : col + reach + 1, 0].astype(float)
    y, x = np.indices(part.shape)
    return np.asarray(np.array([(part * x).sum(), (part * y).sum()]) / part.sum() + [col - reach, row - reach])


@pytest.mark.parametrize("size", [s for s in SIZES if min(s) > 300])
def test_a_spot_shows_where_the_map_says(size: tuple[int, int]) -> None:
    plan = plan_preparation(size, 512)
    shrink = float(plan.scale[0])
    places = np.array([[0.31, 0.42], [0.7, 0.35], [0.5, 0.62]]) * size + [0.3, -0.2]
    sigma = 4.0 / shrink
    seen = plan.apply(spots(size, places, sigma))
    assert seen.shape == (*plan.size[::-1], 3)
    for place in places:
        expected = plan.to_network(place)
        # Rounding to 256 levels leaves a few thousandths of a pixel; half a pixel is what a wrong convention leaves.
        assert np.abs(centroid(seen, expected, 20) - expected).max() < 0.01


@pytest.mark.parametrize("size", SIZES)
def test_lenses_go_there_and_back(size: tuple[int, int]) -> None:
    plan = plan_preparation(size, 512)
    lens = plan.photo_lens(500.0, np.array([256.0, 200.0]))
    assert (lens.width, lens.height) == size
    # Where rounding stretches one axis, the focal length is between those of the axes.
    assert lens.focal_px == pytest.approx(500 * max(size) / 512, rel=0.5 / min(plan.resized))
    back = network_lens(lens, plan)
    assert (back.width, back.height) == plan.size
    assert (back.focal_px, back.cx, back.cy) == pytest.approx((500.0, 256.0, 200.0))


# ---- settings -----------------------------------------------------------------------------------------


def test_defaults_are_upstreams() -> None:
    assert settings_from_environment({}) == Mast3rSettings()
    assert Mast3rSettings().schedule == (300, 300)


def test_every_variable_is_read(tmp_path: Path) -> None:
    given = {
        "HOME": str(tmp_path),
        "WEIGHTS": str(tmp_path / "w"),
        "WEIGHTS_SHA256": "ab",
        "PYTHON": "py",
        "DEVICE": "cuda:1",
        "GRAPH": "swin-3",
        "SIZE_PX": "384",
        "SUBSAMPLE": "4",
        "SCHEDULE": "50, 60",
        "CONFIDENCE": "2.5",
        "CACHE": str(tmp_path / "c"),
    }
    assert set(given) == set(VARIABLES)
    found = settings_from_environment({f"SPECIMAP_MAST3R_{k}": v for k, v in given.items()})
    assert found == Mast3rSettings(
        tmp_path, tmp_path / "w", "ab", "py", "cuda:1", "swin-3", 384, 4, (50, 60), 2.5, tmp_path / "c"
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("DEVICE", "gpu"),
        ("GRAPH", "swin-0"),
        ("GRAPH", "all"),
        ("SIZE_PX", "500"),
        ("SIZE_PX", "x"),
        ("SUBSAMPLE", "3"),
        ("SCHEDULE", "300"),
        ("SCHEDULE", "0,10"),
        ("CONFIDENCE", "0.5"),
        ("CONFIDENCE", "nan"),
    ],
)
def test_values_that_cannot_be_are_refused(name: str, value: str) -> None:
    with pytest.raises(SettingsError) as caught:
        settings_from_environment({f"SPECIMAP_MAST3R_{name}": value})
    assert caught.value.details["setting"] == f"SPECIMAP_MAST3R_{name}"
    assert caught.value.advice.startswith("It takes ")


def test_pairs_of_few_photos_are_all_and_of_many_a_window() -> None:
    assert Mast3rSettings().pairs(4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert len(Mast3rSettings().pairs(30)) == 30 * 29 // 2
    many = Mast3rSettings().pairs(40)
    assert len(many) == 40 * 10
    assert (0, 39) in many
    assert (0, 20) not in many
    assert Mast3rSettings(graph="swin-1").pairs(4) == [(0, 1), (0, 3), (1, 2), (2, 3)]
    assert Mast3rSettings(graph="swin-9").pairs(3) == [(0, 1), (0, 2), (1, 2)]


# ---- the child's failures and progress ----------------------------------------------------------------


def anchor_depth_offsets(depth: float) -> None:
    assert depth > 0


def sparse_scene_optimizer(edges: int) -> None:
    if edges < 0:
        raise RuntimeError("max(): Expected reduction dim to be specified for input.numel() == 0.")
    assert edges > 0


def prepare(img: str, then: Callable[[float], None]) -> None:
    assert img
    then(-1)


def test_upstreams_assertion_on_depth_names_the_photo() -> None:
    with (
        pytest.raises(DepthNotFoundError, match=r"b\.jpg a depth that is not positive") as caught,
        TypedFailures(["a.jpg", "b.jpg"]),
    ):
        prepare("1", anchor_depth_offsets)
    assert caught.value.details == {"photos": ["b.jpg"]}


@pytest.mark.parametrize("edges", [0, -1])
def test_upstreams_failures_to_connect(edges: int) -> None:
    with pytest.raises(PhotosNotConnectedError, match="cannot align"), TypedFailures(["a.jpg"]):
        sparse_scene_optimizer(edges)


def test_other_failures_stay_what_they_are() -> None:
    with pytest.raises(AssertionError), TypedFailures(["a.jpg"]):
        prepare("", anchor_depth_offsets)
    with pytest.raises(ZeroDivisionError), TypedFailures([]):
        _ = 1 / 0


def good_answer() -> dict[str, NDArray[np.float64]]:
    return {
        "focal": np.ones(2),
        "cam_to_world": np.stack([np.eye(4)] * 2),
        "depth": np.ones((2, 3, 3)),
        "confidence": np.ones((2, 3, 3)),
    }


def test_what_is_not_a_number_is_refused_or_dropped() -> None:
    found = good_answer()
    found["depth"][0, 0] = [np.nan, -1, np.inf]
    require_finite(found, ["a", "b"])
    assert found["depth"][0, 0].tolist() == [0, 0, 0]
    assert found["depth"].sum() == 15
    found["depth"][:] = np.nan
    with pytest.raises(DepthNotFoundError):
        require_finite(found, ["a", "b"])
    found = good_answer()
    found["cam_to_world"][1, 0, 0] = np.nan
    with pytest.raises(PhotosNotConnectedError) as caught:
        require_finite(found, ["a", "b"])
    assert caught.value.details == {"photos": ["b"]}


def test_upstreams_bars_become_steps_in_their_order() -> None:
    described: list[tuple[str, float]] = []
    bar = bars(lambda name, share: described.append((name, share)))
    for _ in bar([1, 2]):
        pass
    for _ in bar([1]):
        pass
    for _ in STEPS[2:]:
        with bar(total=4) as inner:
            inner.set_postfix_str("x")
            inner.update(1)
    assert described == [
        ("pairs", 0.5),
        ("pairs", 1.0),
        ("views", 1.0),
        ("coarse", 0.25),
        ("coarse", 1.0),
        ("fine", 0.25),
        ("fine", 1.0),
    ]

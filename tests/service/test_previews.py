"""Pictures show the cloud's own values where its points are, and nothing elsewhere."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from specimap_core.cloud import Cloud
from specimap_service.clouds import pictures
from specimap_service.clouds.picture_cache import PictureCache
from specimap_service.clouds.pictures import Picture
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """One for all tests here, since its drawing processes take a second to start."""
    with serving(tmp_path_factory.mktemp("previews")) as running:
        yield running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def client(service: Running) -> httpx.Client:
    return service.client(["read", "label"])


def picture(answer: httpx.Response) -> NDArray[np.uint8]:
    """RGBA (rows, cols, 4)."""
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


def at_points(image: NDArray[np.uint8], cloud: Cloud) -> NDArray[np.uint8]:
    """Colours (S, 3) of the points' pixels; all else is transparent."""
    assert image.shape == (70, 53, 4)
    row, col = cloud.hsi_pixel.T.astype(int)
    covered = np.zeros(image.shape[:2], bool)
    covered[row, col] = True
    np.testing.assert_array_equal(image[..., 3] > 0, covered)
    return image[row, col, :3]


def stretched(values: NDArray[np.float64]) -> NDArray[np.int_]:
    low, high = np.percentile(values, [2, 98])
    return np.asarray(np.rint(np.clip((values - low) / (high - low) * 255, 0, 255)), int)


def previews(result: Result, kind: str) -> str:
    return f"/v1/clouds/{result.cloud_id}/previews/{kind}.png"


def test_rgb_is_the_photos_colour(client: httpx.Client, result: Result) -> None:
    shown = at_points(picture(client.get(previews(result, "rgb"))), result.cloud)
    np.testing.assert_array_equal(shown, result.cloud.rgb)


@pytest.mark.parametrize("asked", [{"b": "3"}, {"b": "700nm"}, {"nm": "731"}])
def test_band_by_index_and_wavelength(client: httpx.Client, result: Result, asked: dict[str, str]) -> None:
    answer = client.get(previews(result, "band"), params=asked)
    shown = at_points(picture(answer), result.cloud).astype(int)
    values = result.cloud.band(3).astype(float)
    assert np.abs(shown - stretched(values)[:, None]).max() <= 1
    low, high = map(float, answer.headers["x-specimap-range"].split(","))
    np.testing.assert_allclose([low, high], np.percentile(values, [2, 98]), rtol=1e-4)


def test_band_between_given_values(client: httpx.Client, result: Result) -> None:
    answer = client.get(previews(result, "band"), params={"b": "0", "low": 0, "high": 6})
    shown = at_points(picture(answer), result.cloud).astype(int)
    assert np.abs(shown[:, 0] - np.rint(result.cloud.band(0) / 6 * 255)).max() <= 1
    assert answer.headers["x-specimap-range"] == "0,6"


def test_composite(client: httpx.Client, result: Result) -> None:
    asked = {"r": "6", "g": "500nm", "b": "0"}
    shown = at_points(picture(client.get(previews(result, "composite"), params=asked)), result.cloud).astype(int)
    for channel, band in enumerate((6, 1, 0)):
        expected = stretched(result.cloud.band(band).astype(float))
        assert np.abs(shown[:, channel] - expected).max() <= 1
    by_default = at_points(picture(client.get(previews(result, "composite"))), result.cloud)
    np.testing.assert_array_equal(by_default[:, 1], shown[:, 1])  # 550 nm lies between: the first of equals


def test_index_is_a_colour_scale_over_its_range(client: httpx.Client, result: Result) -> None:
    answer = client.get(previews(result, "index"), params={"a": "4", "b": "1", "low": -1, "high": 1})
    shown = at_points(picture(answer), result.cloud).astype(int)
    a, b = (result.cloud.band(i).astype(float) for i in (4, 1))
    level = np.rint(((a - b) / (a + b) + 1) / 2 * 255).astype(int)
    viridis = {0: (68, 1, 84), 255: (253, 231, 37)}
    for end, colour in viridis.items():
        nearest = np.abs(level - end).argmin()
        assert np.abs(shown[nearest] - colour).max() <= 3 * abs(level[nearest] - end) + 1
    # Equal steps in colour order: the higher the index, the lighter.
    light = shown @ [0.299, 0.587, 0.114]
    order = np.argsort(level)
    assert (np.diff(light[order]) >= -1.5).all()
    assert answer.headers["x-specimap-range"] == "-1,1"


def test_index_of_nothing_is_transparent(service: Running, tmp_path: Path, client: httpx.Client) -> None:
    values = counts(20, 20, 3)
    values[10:, :, :2] = 0
    dark = put_result(service, tmp_path / "dark", cube=FakeCube(values), points=scene(20, 20, share=1))
    image = picture(client.get(previews(dark, "index"), params={"a": "0", "b": "1"}))
    assert (image[:10, :, 3] == 255).all()
    assert not image[10:].any()


def test_pca_is_the_runs_own_preview(client: httpx.Client, result: Result) -> None:
    shown = at_points(picture(client.get(previews(result, "pca"))), result.cloud).astype(int)
    stored = np.asarray(Image.open(result.local / "preview.png").convert("RGBA"))[..., :3].astype(int)
    # Points lie 0.1 mm apart, as the preview's pixels do: each has one of its own, give or take a neighbour.
    xyz = result.cloud.xyz
    col = np.rint((xyz[:, 0] - xyz[:, 0].min()) / 0.1).astype(int)
    row = stored.shape[0] - 1 - np.rint((xyz[:, 1] - xyz[:, 1].min()) / 0.1).astype(int)
    np.testing.assert_array_equal(shown, stored[row, col])


def test_from_above(client: httpx.Client, result: Result) -> None:
    answer = client.get(previews(result, "rgb"), params={"grid": "marker", "size": 20})
    image, cloud = picture(answer), result.cloud
    x_min, y_min, x_max, y_max = map(float, answer.headers["x-specimap-extent-mm"].split(","))
    assert max(image.shape) == 20
    mm = (x_max - x_min) / image.shape[1]
    assert (y_max - y_min) / image.shape[0] == pytest.approx(mm, abs=1e-4)
    col = ((cloud.xyz[:, 0] - x_min) / mm).astype(int)
    row = ((y_max - cloud.xyz[:, 1]) / mm).astype(int)
    for r, c in [(0, 0), (10, 7), (19, 14), (5, 3)]:
        inside = (row == r) & (col == c)
        inside &= cloud.xyz[:, 2] >= cloud.xyz[inside, 2].max() - 1
        assert np.abs(image[r, c, :3] - cloud.rgb[inside].mean(0)).max() <= 0.51
        assert image[r, c, 3] == 255


def test_size_bounds_the_longer_side_and_never_enlarges(client: httpx.Client, result: Result) -> None:
    small = picture(client.get(previews(result, "rgb"), params={"size": 35}))
    assert small.shape == (35, 26, 4)
    block = np.zeros((70, 53, 4))
    row, col = result.cloud.hsi_pixel.T.astype(int)
    block[row, col] = np.column_stack([result.cloud.rgb, np.full(len(row), 255)])
    opaque = block[20:22, 0:2].reshape(-1, 4)
    seen = opaque[opaque[:, 3] > 0, :3].mean(0)
    # 53 columns become 26: the first takes in a little of the third.
    assert np.abs(small[10, 0, :3] - seen).max() < 12
    assert picture(client.get(previews(result, "rgb"), params={"size": 2048})).shape == (70, 53, 4)


def put_label(client: httpx.Client, result: Result, told: dict[str, object], values: NDArray[np.generic]) -> None:
    body = io.BytesIO()
    np.save(body, values)
    headers = {"X-Specimap-Label": json.dumps({"made_by": {"name": "m"}, **told}), "Content-Type": "application/x-npy"}
    answer = client.put(f"/v1/clouds/{result.cloud_id}/labels/tissue", content=body.getvalue(), headers=headers)
    assert answer.status_code == 201


def dimmed(cloud: Cloud) -> NDArray[np.float64]:
    grey: NDArray[np.float64] = pictures.DIM * (cloud.rgb @ np.array([0.299, 0.587, 0.114]))
    return grey


def test_classes_in_their_colours_over_the_dimmed_photos(client: httpx.Client, result: Result) -> None:
    cloud = result.cloud
    classes = [{"value": 0, "name": "none"}, {"value": 9, "name": "tumour", "colour": "#ff8000"}]
    values = np.random.default_rng(0).choice([0, 9], cloud.n_points)
    put_label(client, result, {"kind": "class", "classes": classes}, values)
    asked = {"name": "tissue"}
    first = client.get(previews(result, "label"), params=asked)
    shown = at_points(picture(first), cloud).astype(float)
    colour = np.where((values == 9)[:, None], (1 - pictures.DIM) * np.array([255, 128, 0]), 0)
    assert np.abs(shown - dimmed(cloud)[:, None] - colour).max() <= 0.51
    # A new version is another picture at the same address.
    put_label(client, result, {"kind": "class", "classes": classes}, 9 - values)
    again = client.get(previews(result, "label"), params=asked, headers={"If-None-Match": first.headers["etag"]})
    assert again.status_code == 200
    assert again.headers["etag"] != first.headers["etag"]
    old = client.get(previews(result, "label"), params={**asked, "version": 1})
    assert old.content == first.content


def test_probabilities_as_a_colour_scale(client: httpx.Client, result: Result) -> None:
    cloud = result.cloud
    classes = [{"value": 1, "name": "tumour"}, {"value": 4, "name": "healthy"}]
    chances = np.zeros((cloud.n_points, 2), np.float32)
    chances[:, 1] = 1
    chances[7] = np.nan
    put_label(client, result, {"kind": "probability", "classes": classes}, chances)
    output = np.arange(cloud.n_points) != 7
    for asked, colour in (({}, (68, 1, 84)), ({"class": "4"}, (253, 231, 37))):
        answer = client.get(previews(result, "label"), params={"name": "tissue", **asked})
        shown = at_points(picture(answer), cloud).astype(float)
        expected = dimmed(cloud)[:, None] + (1 - pictures.DIM) * np.array(colour) * output[:, None]
        assert np.abs(shown - expected).max() <= 1
        assert answer.headers["x-specimap-range"] == "0,1"
    unknown = client.get(previews(result, "label"), params={"name": "tissue", "class": 2})
    assert (unknown.status_code, unknown.json()["details"]) == (404, {"classes": [1, 4]})


def test_etag_spares_the_drawing(service: Running, client: httpx.Client, result: Result) -> None:
    cache: PictureCache = service.app.state.pictures.cache
    before = cache.kept_bytes
    first = client.get(previews(result, "band"), params={"b": "1"})
    kept = cache.kept_bytes
    assert kept == before + len(first.content)
    tag = first.headers["etag"]
    for given in (tag, f'"x", W/{tag}', "*"):
        known = client.get(previews(result, "band"), params={"b": "1"}, headers={"If-None-Match": given})
        assert (known.status_code, known.content, known.headers["etag"]) == (304, b"", tag)
    assert client.get(previews(result, "band"), params={"b": "1"}).content == first.content
    assert cache.kept_bytes == kept
    other = client.get(previews(result, "band"), params={"b": "2"}, headers={"If-None-Match": tag})
    assert other.status_code == 200


@pytest.mark.parametrize("kind", ["band", "composite", "index", "label"])
def test_no_client_has_a_picture_that_cannot_be(client: httpx.Client, result: Result, kind: str) -> None:
    asked = {"band": {"b": "7"}, "composite": {"r": "7"}, "index": {"a": "7", "b": "1"}, "label": {"name": "none"}}
    answer = client.get(previews(result, kind), params=asked[kind], headers={"If-None-Match": "*"})
    assert answer.status_code == 404


IMPOSSIBLE: list[tuple[str, dict[str, str], int]] = [
    ("band", {}, 422),
    ("band", {"b": "1", "nm": "500"}, 422),
    ("band", {"b": "x"}, 422),
    ("band", {"b": "7"}, 404),
    ("band", {"b": "-1"}, 422),
    ("band", {"nm": "250"}, 404),
    ("band", {"b": "1200nm"}, 404),
    ("band", {"nm": "nan"}, 422),
    ("band", {"b": "1", "low": "1"}, 422),
    ("band", {"b": "1", "low": "2", "high": "1"}, 422),
    ("band", {"b": "1", "low": "nan", "high": "1"}, 422),
    ("index", {"a": "1"}, 422),
    ("index", {"a": "1", "b": "99"}, 404),
    ("composite", {"r": "99999"}, 404),
    ("rgb", {"size": "4096"}, 422),
    ("rgb", {"size": "0"}, 422),
    ("rgb", {"grid": "photo"}, 422),
    ("label", {}, 422),
    ("label", {"name": "none"}, 404),
    ("label", {"name": "../x"}, 422),
    ("nothing", {}, 404),
]


def test_what_cannot_be_drawn(client: httpx.Client, result: Result) -> None:
    for kind, asked, status in IMPOSSIBLE:
        answer = client.get(previews(result, kind), params=asked)
        assert (kind, asked, answer.status_code) == (kind, asked, status), answer.text
        assert answer.json()["advice"]


def test_who_may_see(service: Running, result: Result) -> None:
    assert service.client(["upload"]).get(previews(result, "rgb")).status_code == 403
    nowhere = f"/v1/clouds/cloud_{'0' * 26}/previews/rgb.png"
    assert service.client(["read"]).get(nowhere).json()["code"] == "not_found"


def test_cache_drops_what_was_not_used_for_longest() -> None:
    cache, drawn = PictureCache(most_bytes=100), []

    def get(tag: str) -> None:
        found = cache.find(tag)
        if found is None:
            drawn.append(tag)
            cache.keep(tag, Picture(bytes(40), None, None))
        else:
            assert len(found.png) == 40

    for tag in ("a", "b", "a", "c", "a", "b"):
        get(tag)
    assert drawn == ["a", "b", "c", "b"]
    assert cache.kept_bytes == 80
    huge = Picture(bytes(200), None, None)
    cache.keep("huge", huge)
    assert cache.find("huge") is None
    assert cache.kept_bytes == 0


@pytest.mark.slow
def test_one_point(service: Running, tmp_path: Path, client: httpx.Client) -> None:
    points = scene(20, 20)
    alone = type(points)(**{name: values[:1] for name, values in vars(points).items()})
    one = put_result(service, tmp_path / "one", cube=FakeCube(counts(20, 20, 2)), points=alone)
    row, col = one.cloud.hsi_pixel[0]
    for grid, place in (("cube", (row, col)), ("marker", (0, 0))):
        for kind, asked in (("rgb", {}), ("band", {"b": "1"}), ("index", {"a": "0", "b": "1"}), ("pca", {})):
            image = picture(client.get(previews(one, kind), params={"grid": grid, **asked}))
            assert image[place][3] == 255
            assert (image[..., 3] > 0).sum() == 1

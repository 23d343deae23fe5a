"""Clouds read and labelled through the client, against a running service."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import zarr
from PIL import Image

import specimap_client as sc
from specimap_client import _spectra, _spectra_answers
from specimap_client._retries import Retries
from tests.support.client_scene import Live, connect

# ---- clouds -------------------------------------------------------------------------------------------


def test_cloud_tells_what_it_is(live: Live) -> None:
    cloud, truth = live.cloud, live.result.cloud
    assert (cloud.points, cloud.bands, cloud.job_id) == (truth.n_points, truth.bands, live.result.job_id)
    np.testing.assert_allclose(cloud.wavelength_nm, truth.wavelengths_nm)
    assert cloud.good_bands.tolist() == [0, 1, 3, 4, 5, 6]
    assert cloud.quantity == "reflectance"
    (listed,) = live.client.clouds.list(acquisition=live.result.acquisition_id)
    assert listed.id == cloud.id
    np.testing.assert_array_equal(listed.wavelength_nm, cloud.wavelength_nm)


@pytest.fixture(params=["arrow", "npy"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With pyarrow, and as if it were not installed."""
    if request.param == "npy":
        monkeypatch.setattr(_spectra_answers, "has_arrow", lambda: False)
    return str(request.param)


FIELDS = ("xyz", "normal", "rgb", "hsi_pixel", "sigma_mm", "flags")


def test_spectra_of_points_in_the_order_asked_for(live: Live, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_spectra, "LISTED", 400)
    truth = live.result.cloud
    indices = np.random.default_rng(5).integers(0, truth.n_points, 1000)
    found = live.cloud.spectra(indices=indices, fields=FIELDS)
    assert found.values.dtype == np.float32
    np.testing.assert_array_equal(found.indices, indices)
    np.testing.assert_array_equal(found.values, truth.spectra(indices))
    np.testing.assert_array_equal(np.asarray(found), found.values)
    for name in FIELDS:
        wanted = getattr(truth, name)[indices]
        assert (found.fields[name].dtype, found.fields[name].shape) == (wanted.dtype, wanted.shape)
        np.testing.assert_array_equal(found.fields[name], wanted)


def test_spectra_by_place_and_pixel_agree_with_the_cloud(live: Live, form: str) -> None:
    cloud, truth = live.cloud, live.result.cloud
    place = truth.xyz[700].astype(float)
    low, high = place - 1, place + 1
    np.testing.assert_array_equal(np.sort(cloud.spectra(box=(low, high)).indices), np.sort(truth.in_box(low, high)))
    around = cloud.spectra(radius=(place, 1.5), fields=["distance_mm"])
    np.testing.assert_array_equal(np.sort(around.indices), np.sort(truth.in_radius(place, 1.5)))
    assert 0 < around.fields["distance_mm"].max() <= 1.5
    np.testing.assert_array_equal(cloud.spectra(nearest=(place, 5)).indices, truth.nearest(place, 5)[0])
    np.testing.assert_array_equal(cloud.spectra(pixels=truth.hsi_pixel[[9, 3]]).indices, [9, 3])
    inside = cloud.spectra(polygon=[(9.5, 9.5), (9.5, 20.5), (20.5, 20.5), (20.5, 9.5)])
    row, col = truth.hsi_pixel[:, 0], truth.hsi_pixel[:, 1]
    wanted = np.flatnonzero((row >= 10) & (row <= 20) & (col >= 10) & (col <= 20))
    np.testing.assert_array_equal(np.sort(inside.indices), wanted)


def test_spectra_in_some_bands_and_in_pages(live: Live, form: str) -> None:
    cloud, truth = live.cloud, live.result.cloud
    by_nm = cloud.spectra(indices=[1, 2], nm=(500, 700))
    np.testing.assert_allclose(by_nm.wavelength_nm, [500, 600, 700])
    np.testing.assert_array_equal(by_nm.values, truth.spectra([1, 2], [1, 2, 3]))
    np.testing.assert_array_equal(cloud.spectra(indices=[1], bands=[6, 0]).values, truth.spectra([1], [6, 0]))
    everywhere = ([-1e4] * 3, [1e4] * 3)
    pages = list(cloud.iter_spectra(page=700, box=everywhere, bands=[4], fields=["flags"]))
    assert [len(page) for page in pages[:-1]] == [700] * (len(pages) - 1)
    assert sum(map(len, pages)) == cloud.points > 2000
    whole = cloud.spectra(box=everywhere, bands=[4], fields=["flags"])
    np.testing.assert_array_equal(np.concatenate([page.values for page in pages]), whole.values)
    np.testing.assert_array_equal(whole.fields["flags"], truth.flags[whole.indices])
    nothing = cloud.spectra(radius=((1e4, 0, 0), 1), fields=["xyz"])
    assert (nothing.values.shape, nothing.fields["xyz"].shape) == ((0, 7), (0, 3))
    assert cloud.spectra(indices=[], fields=["flags"]).fields["flags"].shape == (0,)


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"indices": [1], "pixels": [(1, 1)]},
        {"indices": [True, False]},
        {"indices": [1.5]},
        {"pixels": [1, 2]},
        {"indices": [1], "nm": (1, 2)},
        {"indices": [1], "bands": [7]},
        {"indices": [1], "bands": [1], "nm": (1, 2)},
        {"radius": ((1, 2), 3)},
    ],
)
def test_selections_that_cannot_be_meant_are_refused_here(live: Live, wrong: _spectra.Selection) -> None:
    with pytest.raises(ValueError, match=r"give|numbers|shape|no such band|coordinates"):
        live.cloud.spectra(**wrong)


def test_single_points_and_bands(live: Live) -> None:
    cloud, truth = live.cloud, live.result.cloud
    point = cloud.point(17)
    np.testing.assert_allclose(point.xyz, truth.xyz[17])
    np.testing.assert_allclose(point.spectrum, truth.spectra([17])[0], rtol=1e-6)
    assert point.hsi_pixel == tuple(truth.hsi_pixel[17])
    np.testing.assert_array_equal(cloud.band(5), truth.band(5))
    with pytest.raises(sc.NotFound):
        cloud.point(10**6)


def test_arrays_come_through_zarr_and_xarray(live: Live) -> None:
    cloud, truth = live.cloud, live.result.cloud
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(cloud, name), getattr(truth, name))
    group = cloud.zarr()
    assert group.attrs["frame"] == "marker"
    stored = group["spectra"]
    assert isinstance(stored, zarr.Array)
    np.testing.assert_allclose(np.asarray(stored[1000:1010]) * 1e-4, truth.spectra(slice(1000, 1010)))
    with pytest.raises(ValueError, match="read-only"):
        stored[0] = 0
    data = cloud.xarray()
    assert data["spectra"].dims == ("point", "band")
    np.testing.assert_allclose(data["spectra"][500:600].values, truth.spectra(slice(500, 600)), rtol=1e-6)
    near = data["spectra"].isel(point=3).swap_dims(band="wavelength_nm").sel(wavelength_nm=610, method="nearest")
    np.testing.assert_allclose(near, truth.spectra([3], [2])[0, 0], rtol=1e-6)


def test_pictures_are_drawn(live: Live, tmp_path: Path) -> None:
    for kind, parameters in (("rgb", {"size": 64}), ("band", {"nm": 600}), ("index", {"a": 1, "b": 3})):
        path = tmp_path / f"{kind}.png"
        path.write_bytes(live.cloud.preview(kind, **parameters))
        with Image.open(path) as picture:
            assert min(picture.size) > 10


# ---- labels -------------------------------------------------------------------------------------------

CLASSES = [(0, "unlabelled"), (1, "tumour", "#d62728"), (2, "healthy – normal", "#2ca02c")]


def layer(group: zarr.Group, name: str) -> np.ndarray:
    """Values of a label layer of a group."""
    array = group[f"labels/{name}"]
    assert isinstance(array, zarr.Array)
    return np.asarray(array[...])


def test_labels_are_written_in_versions_and_read_back(live: Live) -> None:
    cloud = live.cloud
    values = np.random.default_rng(1).integers(0, 3, cloud.points)
    made = cloud.put_label(
        "tissue", values, classes=CLASSES, made_by={"name": "net-3d", "version": "1.4"}, if_version=0
    )
    assert (made.version, made.kind, made.made_by["version"]) == (1, "class", "1.4")
    assert [(c.value, c.name, c.colour) for c in made.classes][2] == (2, "healthy – normal", "#2ca02c")
    np.testing.assert_array_equal(made.values(), values)
    # The same again, as after a lost answer, is no new version, whatever version was expected.
    again = cloud.put_label(
        "tissue", values, classes=CLASSES, made_by={"name": "net-3d", "version": "1.4"}, if_version=0
    )
    assert again.version == 1
    second = cloud.put_label("tissue", 2 - values, classes=CLASSES, made_by="net-3d", if_version=1)
    assert second.version == 2
    with pytest.raises(sc.Conflict):
        cloud.put_label("tissue", values * 0, classes=CLASSES, made_by="net-3d", if_version=1)
    np.testing.assert_array_equal(cloud.label("tissue").values(), 2 - values)
    np.testing.assert_array_equal(cloud.label("tissue", version=1).values(), values)
    np.testing.assert_array_equal(layer(live.cloud.zarr(), "tissue"), 2 - values)
    assert cloud.point(4).labels["tissue"] == 2 - values[4]


def test_probabilities_are_labels_too(live: Live) -> None:
    cloud = live.cloud
    share = np.random.default_rng(2).random((cloud.points, 2)).astype(np.float32)
    two = [(1, "tumour", "#d62728"), (2, "healthy")]
    label = cloud.put_label("share", share, classes=two, made_by="net-3d")
    assert label.kind == "probability"
    np.testing.assert_array_equal(label.values(), share)
    np.testing.assert_array_equal(cloud.put_label("risk", share[:, 0], made_by="net-3d").values(), share[:, 0])
    assert {found.name for found in cloud.labels()} >= {"share", "risk"}


def test_labels_that_do_not_fit_are_refused(live: Live) -> None:
    cloud = live.cloud
    for wrong in (np.zeros(cloud.points - 1, int), np.zeros(cloud.points, bool), np.zeros((cloud.points, 2), int)):
        with pytest.raises(ValueError, match=r"type|shape"):
            cloud.put_label("wrong", wrong, classes=CLASSES, made_by="x")
    with pytest.raises(sc.Refused):
        cloud.put_label("wrong", np.full(cloud.points, 9), classes=CLASSES, made_by="x")
    with connect(live.service, ["read"]) as reader, pytest.raises(sc.Forbidden) as caught:
        reader.clouds.get(cloud.id).put_label("tissue", np.zeros(cloud.points, int), classes=CLASSES, made_by="x")
    assert caught.value.details["scope"] == "label"


# ---- files --------------------------------------------------------------------------------------------


def test_whole_cloud_is_downloaded(live: Live, tmp_path: Path) -> None:
    cloud = live.cloud
    values = np.arange(cloud.points) % 3
    cloud.put_label("loaded", values, classes=CLASSES, made_by="x")
    heard: list[sc.Progress] = []
    folder = live.cloud.download(tmp_path / "cloud.zarr", progress=heard.append)
    assert heard[-1].sent == heard[-1].size
    own = {f.relative_to(folder).as_posix(): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
    source = live.result.local / "cloud.zarr"
    for file in (f for f in source.rglob("*") if f.is_file() and f.name != "zarr.json"):
        assert own[file.relative_to(source).as_posix()] == file.read_bytes()
    np.testing.assert_array_equal(layer(zarr.open_group(folder, mode="r"), "loaded"), values)
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.zarr"]
    with pytest.raises(FileExistsError):
        live.cloud.download(tmp_path / "cloud.zarr")


def test_export_is_downloaded_and_goes_on_where_it_broke(live: Live, tmp_path: Path) -> None:
    class Cutting(httpx.HTTPTransport):
        """Answers break off after 3000 bytes, twice."""

        left = 2
        ranges: list[str]

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            answer = super().handle_request(request)
            if not request.url.path.endswith("/content"):
                return answer
            self.ranges = [*getattr(self, "ranges", []), request.headers.get("Range", "")]
            if self.left:
                self.left -= 1
                answer.stream = _Cut(answer.stream)
            return answer

    transport = Cutting()
    key = live.service.key()
    with sc.Client(live.service.url, key, transport=transport, retries=Retries(attempts=3, first_s=0.01)) as client:
        target = client.clouds.get(live.result.cloud_id).export("mesh-ply", tmp_path / "mesh.ply")
    assert target.read_bytes() == (live.result.local / "mesh.ply").read_bytes()
    assert transport.ranges == ["", "bytes=3000-", "bytes=6000-"]
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]
    assert "mesh-ply" in {export.format for export in live.cloud.exports()}


class _Cut(httpx.SyncByteStream):
    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __iter__(self) -> Iterator[bytes]:
        content = b"".join(self._stream)
        yield content[:3000]
        raise httpx.ReadError("cut")

    def close(self) -> None:
        self._stream.close()


# ---- shares -------------------------------------------------------------------------------------------


def test_link_shows_one_result_until_it_is_revoked(live: Live) -> None:
    until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=3)
    share = live.cloud.share("tumour board", until)
    assert share.link == f"{live.client.url}/#/shared/{share.token}"
    assert share.token not in repr(share)
    with httpx.Client(base_url=live.client.url, headers={"Specimap-Page": "1"}, trust_env=False) as visitor:
        assert visitor.post("/v1/session", json={"share": share.token}).status_code == 201
        assert visitor.get(f"/v1/clouds/{live.cloud.id}").status_code == 200
    (listed,) = live.cloud.shares()
    assert (listed.id, listed.name, listed.revoked_at) == (share.id, "tumour board", None)
    assert abs(listed.expires_at - until) < datetime.timedelta(seconds=1)
    live.cloud.revoke_share(listed)
    assert live.cloud.shares()[0].revoked_at is not None
    with httpx.Client(base_url=live.client.url, headers={"Specimap-Page": "1"}, trust_env=False) as visitor:
        assert visitor.post("/v1/session", json={"share": share.token}).status_code == 401
    with pytest.raises(sc.Refused):
        live.cloud.share("too long", until + datetime.timedelta(days=300))

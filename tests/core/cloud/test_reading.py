"""Reading the spectral cloud: what is written is what is read, by Specimap and by plain Zarr readers."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr

from specimap_core.arrays import Array
from specimap_core.cloud import ARRAYS, CHUNK_POINTS, Cloud, CloudPoints, tile_order
from specimap_core.cloud import shards as shards_module
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import CloudDamagedError, NotFoundError
from tests.support.cloud_scene import FakeCube, counts, scene


@pytest.fixture(scope="module")
def cube() -> FakeCube:
    return FakeCube(counts())


@pytest.fixture(scope="module")
def points(cube: FakeCube) -> CloudPoints:
    return scene(cube.rows, cube.cols)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, cube: FakeCube, points: CloudPoints) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "cloud.zarr"
    write_cloud(path, points, cube, {"report": {"method": "camera"}, "settings": {"r_pc": np.float32(0.5)}})
    return path


@pytest.fixture(scope="module")
def cloud(path: Path) -> Cloud:
    return Cloud.open(path)


# ---- round trips ----------------------------------------------------------------------------------------


def test_round_trip(cloud: Cloud, cube: FakeCube, points: CloudPoints) -> None:
    order = tile_order(points.hsi_pixel)
    for name, values in vars(points).items():
        np.testing.assert_array_equal(getattr(cloud, name), values[order], err_msg=name)
        assert getattr(cloud, name).dtype == values.dtype
    row, col = cloud.hsi_pixel.astype(int).T
    np.testing.assert_array_equal(cloud.stored_spectra(slice(None)), cube.values[row, col])
    np.testing.assert_allclose(cloud.wavelengths_nm, cube.wavelengths_nm, rtol=1e-6)
    assert (cloud.n_points, cloud.bands) == (len(points), cube.bands)
    assert (cloud.quantity, cloud.scale_factor, cloud.add_offset) == ("reflectance", 1e-4, 0)
    assert cloud.report == {"method": "camera"}
    assert cloud.attributes["settings"] == {"r_pc": 0.5}
    assert cloud.attributes["frame"] == "marker"


def test_boxes_bound_their_chunks_tightly(cloud: Cloud) -> None:
    assert len(cloud.chunk_aabb) == -(-cloud.n_points // CHUNK_POINTS)
    for i, box in enumerate(cloud.chunk_aabb):
        xyz = cloud.xyz[i * CHUNK_POINTS : (i + 1) * CHUNK_POINTS]
        np.testing.assert_array_equal(box, np.concatenate([xyz.min(0), xyz.max(0)]))


def test_plain_zarr_reads_it(path: Path, cloud: Cloud) -> None:
    group = zarr.open_group(path, mode="r")
    assert group.metadata.zarr_format == 3
    assert sorted(group.array_keys()) == sorted(ARRAYS)
    for name, spec in ARRAYS.items():
        array = group[name]
        assert isinstance(array, zarr.Array)
        assert array.dtype == spec.dtype
        assert array.metadata.dimension_names == spec.dimensions  # type: ignore[union-attr]
        mine = cloud.array(name)
        np.testing.assert_array_equal(np.asarray(array[...]), mine.read(0, mine.shape[0]))
    spectra = group["spectra"]
    assert isinstance(spectra, zarr.Array)
    assert spectra.chunks == (256, cloud.bands)
    assert spectra.shards == (131072, cloud.bands)
    assert spectra.attrs["scale_factor"] == 1e-4
    codec = json.loads((path / "spectra" / "zarr.json").read_text())["codecs"][0]["configuration"]["codecs"][1]
    assert codec["name"] == "blosc"
    settings = codec["configuration"]
    assert [settings[k] for k in ("cname", "clevel", "shuffle", "typesize")] == ["lz4", 5, "bitshuffle", 2]


# ---- reading --------------------------------------------------------------------------------------------


def test_spectra_by_point_and_band(cloud: Cloud, cube: FakeCube) -> None:
    row, col = cloud.hsi_pixel.astype(int).T
    truth = cube.values[row, col]
    which = np.array([5, 2000, 5, 0, cloud.n_points - 1, 700])
    np.testing.assert_array_equal(cloud.stored_spectra(which), truth[which])
    np.testing.assert_array_equal(cloud.stored_spectra(which, [6, 0]), truth[which][:, [6, 0]])
    np.testing.assert_array_equal(cloud.stored_spectra(slice(250, 900)), truth[250:900])
    np.testing.assert_array_equal(cloud.stored_spectra(slice(3, 900, 7)), truth[3:900:7])
    np.testing.assert_allclose(cloud.spectra(which), truth[which] * 1e-4, rtol=1e-6)
    np.testing.assert_allclose(cloud.band(3), truth[:, 3] * 1e-4, rtol=1e-6)
    assert cloud.spectra([]).shape == (0, cube.bands)
    seen = [(part, block) for part, block in cloud.iter_chunks(512)]
    assert [part.start for part, _ in seen] == list(range(0, cloud.n_points, 512))
    np.testing.assert_array_equal(np.concatenate([block for _, block in seen]), truth)


@pytest.mark.parametrize("indices", [[-1], [10**7], [0.5]])
def test_points_outside(cloud: Cloud, indices: list[float]) -> None:
    with pytest.raises(NotFoundError):
        cloud.spectra(indices)
    with pytest.raises(NotFoundError):
        cloud.spectra([0], bands=[cloud.bands])


@pytest.mark.parametrize("warm", [False, True])
def test_queries_agree_with_brute_force(path: Path, warm: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = Cloud.open(path).xyz.astype(float)
    cloud = Cloud.open(path)
    if warm:
        assert cloud.xyz.shape == truth.shape
    rng = np.random.default_rng(3)
    for _ in range(20):
        place = truth[rng.integers(len(truth))] + rng.normal(0, 0.5, 3)
        distance = np.linalg.norm(truth - place, axis=1)
        np.testing.assert_array_equal(cloud.in_radius(place, 0.7), np.flatnonzero(distance <= 0.7))
        found, far = cloud.nearest(place, 5)
        np.testing.assert_allclose(far, np.sort(distance)[:5])
        np.testing.assert_allclose(distance[found], far)
        low, high = place - 0.5, place + np.array([0.5, 1, 2])
        inside = ((truth >= low) & (truth <= high)).all(1)
        np.testing.assert_array_equal(cloud.in_box(low, high), np.flatnonzero(inside))
    assert len(cloud.in_radius([500, 0, 0], 1)) == 0
    assert len(cloud.nearest([500, 0, 0], 10**6)[0]) == len(truth)


def test_a_query_reads_few_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ARRAYS, "xyz", replace(ARRAYS["xyz"], chunk_points=256))
    cube = FakeCube(counts(160, 160, 2))
    write_cloud(tmp_path / "c.zarr", scene(160, 160, 1.0), cube, {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    assert len(cloud.chunk_aabb) == 100
    touched: list[int] = []
    read = shards_module.PointArray.read

    def counted(self: shards_module.PointArray, start: int, stop: int, out: Array | None = None) -> Array:
        if self.shape[1:] == (3,):
            touched.append(stop - start)
        return read(self, start, stop, out)

    monkeypatch.setattr(shards_module.PointArray, "read", counted)
    assert len(cloud.in_radius([8.0, -8.0, 0.0], 0.8)) > 10
    assert 0 < sum(touched) <= 9 * 256


def test_at_pixel(cloud: Cloud, points: CloudPoints) -> None:
    for i in (0, 7, cloud.n_points - 1):
        row, col = cloud.hsi_pixel[i].tolist()
        assert cloud.at_pixel(row, col) == i
    taken = {tuple(p) for p in points.hsi_pixel.tolist()}
    row, col = next((r, c) for r in range(70) for c in range(53) if (r, c) not in taken)
    assert cloud.at_pixel(row, col) is None
    assert cloud.at_pixel(-1, 0) is None
    assert cloud.at_pixel(0, 70000) is None


def test_a_group_of_another_layout_reads_too(tmp_path: Path, path: Path, cloud: Cloud) -> None:
    copy = zarr.create_group(tmp_path / "c.zarr", zarr_format=3)
    source = zarr.open_group(path, mode="r")
    for name in ARRAYS:
        array = source[name]
        assert isinstance(array, zarr.Array)
        written = copy.create_array(name, data=np.asarray(array[...]), chunks=(300, *array.shape[1:]))
        written.attrs.update(dict(array.attrs))
    other = Cloud.open(tmp_path / "c.zarr")
    np.testing.assert_array_equal(other.spectra([5, 900]), cloud.spectra([5, 900]))
    np.testing.assert_array_equal(other.band(2), cloud.band(2))
    np.testing.assert_array_equal(other.in_radius([2, -2, 0], 1), cloud.in_radius([2, -2, 0], 1))


def test_labels(tmp_path: Path, cube: FakeCube, points: CloudPoints) -> None:
    write_cloud(tmp_path / "c.zarr", points, cube, {})
    values = np.arange(len(points), dtype=np.uint8)
    zarr.open_group(tmp_path / "c.zarr", mode="a").create_group("labels").create_array("tissue", data=values)
    cloud = Cloud.open(tmp_path / "c.zarr")
    assert cloud.label_names == ("tissue",)
    np.testing.assert_array_equal(cloud.label("tissue"), values)
    with pytest.raises(NotFoundError):
        cloud.label("../xyz")


# ---- refusals -------------------------------------------------------------------------------------------


def test_no_cloud(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        Cloud.open(tmp_path / "nothing.zarr")
    (tmp_path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    with pytest.raises(CloudDamagedError, match="lacks the arrays"):
        Cloud.open(tmp_path)


@pytest.mark.parametrize("damage", ["missing", "truncated", "index", "metadata", "group"])
def test_damage_is_named(tmp_path: Path, cube: FakeCube, points: CloudPoints, damage: str) -> None:
    target = tmp_path / "c.zarr"
    write_cloud(target, points, cube, {})
    shard = target / "spectra" / "c" / "0" / "0"
    content = shard.read_bytes()
    match damage:
        case "missing":
            shard.unlink()
        case "truncated":
            shard.write_bytes(content[: len(content) // 2])
        case "index":
            shard.write_bytes(content[:-1000] + b"\x07" + content[-999:])
        case "metadata":
            (target / "spectra" / "zarr.json").write_text("{")
        case "group":
            (target / "zarr.json").write_text("[]")
    with pytest.raises(CloudDamagedError):
        Cloud.open(target).spectra([0])


# ---- what reading needs ---------------------------------------------------------------------------------


def test_reading_needs_no_heavy_library() -> None:
    script = "import sys, specimap_core.cloud; print({'tensorstore', 'cv2', 'scipy', 'open3d'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"

"""Writing the spectral cloud: its order, its encoding of values, and all or nothing."""

from __future__ import annotations

import errno
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from specimap_core.cloud import ARRAYS, Cloud, CloudPoints, Flag, tile_order
from specimap_core.cloud import writer as writer_module
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import RegistrationError, StorageFullError
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.places import ROOT


@pytest.fixture(scope="module")
def cube() -> FakeCube:
    return FakeCube(counts())


@pytest.fixture(scope="module")
def points(cube: FakeCube) -> CloudPoints:
    return scene(cube.rows, cube.cols)


# ---- order ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@given(st.sets(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF)), max_size=60), st.randoms())
def test_tile_order_is_a_permutation_in_the_order_of_tiles(chosen: set[tuple[int, int]], random: object) -> None:
    pixels = np.array(list(chosen), np.uint16).reshape(-1, 2)
    order = tile_order(pixels)
    assert sorted(order.tolist()) == list(range(len(pixels)))
    want = sorted((r // 16, c // 16, r % 16, c % 16) for r, c in chosen)
    assert [(r // 16, c // 16, r % 16, c % 16) for r, c in pixels[order].tolist()] == want


@given(st.integers(1, 40), st.integers(1, 40))
def test_tiles_are_contiguous(rows: int, cols: int) -> None:
    pixels = np.indices((rows, cols)).reshape(2, -1).T.astype(np.uint16)
    tiles = pixels[tile_order(pixels)] // 16
    changes = 1 + int((np.diff(tiles.astype(int), axis=0) != 0).any(1).sum())
    assert changes == -(-rows // 16) * -(-cols // 16)


# ---- encoding -------------------------------------------------------------------------------------------


def test_a_path_with_dots_is_written_to(tmp_path: Path, cube: FakeCube, points: CloudPoints) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    target = tmp_path / "link" / ".." / "link" / "cloud.zarr"
    write_cloud(target, points, cube, {})
    assert len(Cloud.open(tmp_path / "a" / "cloud.zarr").xyz) == len(points)


def test_several_shards(tmp_path: Path, cube: FakeCube, points: CloudPoints, monkeypatch: pytest.MonkeyPatch) -> None:
    # Shards of 1024 points: strips of tiles begin and end inside them.
    monkeypatch.setattr(writer_module, "SHARD_POINTS", 1024)
    monkeypatch.setitem(ARRAYS, "xyz", replace(ARRAYS["xyz"], chunk_points=512))
    for name in ("hsi_pixel", "normal", "rgb", "sigma_mm", "flags"):
        monkeypatch.setitem(ARRAYS, name, replace(ARRAYS[name], chunk_points=1024))
    heard: list[float] = []
    write_cloud(tmp_path / "c.zarr", points, cube, {}, progress=heard.append)
    cloud = Cloud.open(tmp_path / "c.zarr")
    assert len(list((tmp_path / "c.zarr" / "spectra" / "c").iterdir())) == -(-len(points) // 1024) == 3
    row, col = cloud.hsi_pixel.astype(int).T
    np.testing.assert_array_equal(cloud.stored_spectra(slice(None)), cube.values[row, col])
    np.testing.assert_array_equal(cloud.stored_spectra(slice(900, 2100)), cube.values[row, col][900:2100])
    np.testing.assert_array_equal(cloud.xyz, points.xyz[tile_order(points.hsi_pixel)])
    assert heard == sorted(heard)
    assert heard[-1] == 1


def flagged(cloud: Cloud, flag: Flag) -> set[tuple[int, int]]:
    return {(int(r), int(c)) for r, c in cloud.hsi_pixel[(cloud.flags & flag) > 0]}


def test_float_reflectance_keeps_what_is_negative_large_or_missing(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((20, 20, 5)).astype(np.float32)
    values[3, 4] = [np.nan, 0.5, -0.2, 6.2, 0.1]
    values[5, 6, 1] = np.inf
    values[7, 8, 2] = -np.inf
    values[9, 9, 4] = np.nan  # in a bad band: no flag
    points = scene(20, 20, share=1)
    written = write_cloud(tmp_path / "c.zarr", points, FakeCube(values, to_reflectance=1.0, bad=(4,)), {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    row, col = cloud.hsi_pixel.astype(int).T
    want = np.where(np.isfinite(values), values, np.nan)[row, col]
    got = cloud.spectra(slice(None))
    np.testing.assert_allclose(got, want, rtol=0, atol=0.5001e-4)
    assert int(np.isnan(got).sum()) == 4
    assert flagged(cloud, Flag.NO_DATA) == {(3, 4), (5, 6), (7, 8)}
    assert flagged(cloud, Flag.SATURATED) == set()
    assert (written.no_data, written.saturated, written.clipped_below, written.clipped_above) == (3, 0, 0, 0)
    assert [w.code for w in written.warnings()] == ["points_no_data"]
    assert cloud.bad_bands.tolist() == [False] * 4 + [True]


def test_few_values_far_beyond_all_others_are_clipped_counted_and_flagged(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((70, 60, 5)).astype(np.float32)
    values[3, 4, 1] = 40.0
    values[8, 8, 2] = -2.0
    values[9, 8, 2] = 1e6
    values[9, 9, 2] = -1e6
    written = write_cloud(tmp_path / "c.zarr", scene(70, 60, 1.0), FakeCube(values, to_reflectance=1.0), {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    assert cloud.scale_factor == 1e-4
    assert (written.clipped_below, written.clipped_above, written.absurd) == (1, 1, 2)
    codes = [w.code for w in written.warnings()]
    assert codes == ["points_no_data", "values_absurd", "values_clipped", "values_clipped"]
    assert flagged(cloud, Flag.SATURATED) == {(3, 4)}
    assert flagged(cloud, Flag.NO_DATA) == {(9, 8), (9, 9)}
    row, col = cloud.hsi_pixel.astype(int).T
    want = np.clip(np.where(np.abs(values) > 1e5, np.nan, values)[row, col], written.least, written.largest)
    np.testing.assert_allclose(cloud.spectra(slice(None)), want, rtol=0, atol=0.503e-4)


def test_reflectance_far_above_one_is_kept_in_coarser_steps(tmp_path: Path) -> None:
    values = (100 * np.random.default_rng(0).random((30, 20, 5))).astype(np.float32)
    written = write_cloud(tmp_path / "c.zarr", scene(30, 20, 1.0), FakeCube(values, to_reflectance=1.0), {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    row, col = cloud.hsi_pixel.astype(int).T
    assert 99 / 65534 < cloud.scale_factor < 101 / 65534
    assert (written.clipped_below, written.clipped_above) == (0, 0)
    np.testing.assert_allclose(cloud.spectra(slice(None)), values[row, col], rtol=0, atol=0.51 * cloud.scale_factor)


def test_integer_reflectance_of_another_scale(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(-50, 4096, (17, 18, 3)).astype(np.int16)
    write_cloud(tmp_path / "c.zarr", scene(17, 18), FakeCube(values, to_reflectance=1 / 4095), {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    row, col = cloud.hsi_pixel.astype(int).T
    assert np.abs(cloud.spectra(slice(None)) - values[row, col] / 4095).max() < 0.51e-4
    assert cloud.fill_value is None


@pytest.mark.parametrize(
    ("dtype", "low", "high", "error"),
    [
        ("u1", 0, 255, 0.0),
        ("u2", 0, 65535, 0.0),
        ("i2", -100, 30000, 0.0),
        ("i2", -32768, 32767, 0.0),
        ("u4", 0, 65535, 0.0),
        ("u4", 3_000_000, 3_060_000, 0.0),
        ("u4", 0, 4_000_000_000, 4e9 / 65535 / 2 * 1.01),
        ("f4", -3.0, 900.0, 903 / 65535 / 2 * 1.01),
        ("f8", 5.0, 5.0, 0.0),
    ],
)
def test_counts_decode_to_counts(tmp_path: Path, dtype: str, low: float, high: float, error: float) -> None:
    draw = np.random.default_rng(0).uniform(low, high, (18, 20, 4))
    values = draw.astype(dtype)
    values[0, 0], values[0, 1] = low, high
    write_cloud(tmp_path / "c.zarr", scene(18, 20, 1.0), FakeCube(values, None, "counts"), {})
    cloud = Cloud.open(tmp_path / "c.zarr")
    row, col = cloud.hsi_pixel.astype(int).T
    decoded = cloud.stored_spectra(slice(None)) * cloud.scale_factor + cloud.add_offset
    assert np.abs(decoded - values[row, col]).max() <= error
    np.testing.assert_allclose(cloud.spectra(slice(None)), decoded, rtol=1e-6)
    assert cloud.quantity == "counts"
    assert ("scale_factor" in cloud.array("spectra").attributes) == (error > 0)


def test_saturation(tmp_path: Path) -> None:
    values = counts(20, 20, 4)
    values[2, 3, 1] = 65535
    values[4, 5, 2] = 65535  # a bad band
    values[6, 7, 0] = 61000
    points = scene(20, 20, share=1)
    marked: list[set[tuple[int, int]]] = []
    for saturation in (None, 60500.0):
        cube = FakeCube(values, bad=(2,))
        write_cloud(tmp_path / "c.zarr", points, cube, {}, saturation=saturation)
        cloud = Cloud.open(tmp_path / "c.zarr")
        marked.append({tuple(p) for p in cloud.hsi_pixel[(cloud.flags & 8) > 0].tolist()})
        np.testing.assert_array_equal(cloud.flags & 7, points.flags[tile_order(points.hsi_pixel)])
    assert marked == [{(2, 3)}, {(2, 3), (6, 7)}]


def test_spectra_of_zeros_are_flagged(tmp_path: Path) -> None:
    values = np.maximum(counts(20, 20, 6), 1)
    values[3, 4] = 0
    values[5, 6] = [0, 0, 0, 0, 0, 9]
    values[7, 8] = [0, 0, 9, 0, 0, 0]  # a bad band
    cube = FakeCube(values, bad=(2,))
    written = write_cloud(tmp_path / "c.zarr", scene(20, 20, share=1), cube, {})
    assert flagged(Cloud.open(tmp_path / "c.zarr"), Flag.NO_DATA) == {(3, 4), (7, 8)}
    assert written.no_data == 2


# ---- all or nothing -------------------------------------------------------------------------------------


def test_points_that_do_not_fit(tmp_path: Path, cube: FakeCube, points: CloudPoints) -> None:
    none = CloudPoints(**{name: values[:0] for name, values in vars(points).items()})
    with pytest.raises(RegistrationError):
        write_cloud(tmp_path / "c.zarr", none, cube, {})
    with pytest.raises(ValueError, match="normal"):
        write_cloud(tmp_path / "c.zarr", replace(points, normal=points.normal[1:]), cube, {})
    with pytest.raises(ValueError, match="leaves the cube"):
        write_cloud(tmp_path / "c.zarr", replace(points, hsi_pixel=points.hsi_pixel + np.uint16(9)), cube, {})
    with pytest.raises(ValueError, match="finite"):
        write_cloud(tmp_path / "c.zarr", replace(points, xyz=points.xyz * np.float32(np.nan)), cube, {})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (RuntimeError("the cube broke"), RuntimeError),
        (OSError(errno.ENOSPC, "No space left on device"), StorageFullError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_failed_write_leaves_what_was_there(
    tmp_path: Path, cube: FakeCube, points: CloudPoints, error: Exception, expected: type[BaseException]
) -> None:
    target = tmp_path / "c.zarr"
    broken = replace(cube, fails_at=40, error=error)
    with pytest.raises(expected):
        write_cloud(target, points, broken, {})
    assert list(tmp_path.iterdir()) == []
    write_cloud(target, points, cube, {"run": 1})
    before = Cloud.open(target).stored_spectra(slice(None))
    with pytest.raises(expected):
        write_cloud(target, points, broken, {"run": 2})
    assert [p.name for p in tmp_path.iterdir()] == ["c.zarr"]
    assert Cloud.open(target).attributes["run"] == 1
    np.testing.assert_array_equal(Cloud.open(target).stored_spectra(slice(None)), before)


def test_a_cloud_is_replaced(tmp_path: Path, cube: FakeCube, points: CloudPoints) -> None:
    write_cloud(tmp_path / "c.zarr", points, cube, {"run": 1})
    write_cloud(tmp_path / "c.zarr", scene(20, 20), FakeCube(counts(20, 20, 3)), {"run": 2}, durable=True)
    cloud = Cloud.open(tmp_path / "c.zarr")
    assert (cloud.attributes["run"], cloud.bands) == (2, 3)
    assert [p.name for p in tmp_path.iterdir()] == ["c.zarr"]


_FILE_TOO_LARGE = """
import resource, sys
from pathlib import Path
from tests.support.cloud_scene import FakeCube, counts, scene
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import StorageFullError
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    write_cloud(Path(sys.argv[1]) / "c.zarr", scene(70, 53), FakeCube(counts()), {})
except StorageFullError as error:
    print("full:", error.message)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_the_writers_own_disk_error_is_typed(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _FILE_TOO_LARGE, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("full:"), done.stderr
    assert list(tmp_path.iterdir()) == []

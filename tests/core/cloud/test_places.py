"""Points by pixel and by polygon, and clouds that are not read from a folder."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from specimap_core.cloud import Cloud
from specimap_core.cloud.outline import in_outline
from specimap_core.cloud.source import Folder
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import CloudDamagedError, NotFoundError, SpecimapError
from tests.support.cloud_scene import FakeCube, counts, scene


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "cloud.zarr"
    write_cloud(path, scene(70, 53), FakeCube(counts()), {"note": "x"})
    return path


# ---- pixels and polygons --------------------------------------------------------------------------------


def lies_in(row: int, col: int, outline: list[list[Fraction]]) -> bool:
    """Even-odd by exact arithmetic; a centre on the outline lies inside."""
    y, x, odd = Fraction(row), Fraction(col), False
    for (y1, x1), (y2, x2) in zip(outline, outline[1:] + outline[:1], strict=True):
        in_reach = min(y1, y2) <= y <= max(y1, y2) and min(x1, x2) <= x <= max(x1, x2)
        if in_reach and (x2 - x1) * (y - y1) == (y2 - y1) * (x - x1):
            return True
        if (y1 <= y) != (y2 <= y) and x < x1 + (y - y1) * (x2 - x1) / (y2 - y1):
            odd = not odd
    return odd


GRID = np.moveaxis(np.mgrid[0:14, 0:12], 0, -1).reshape(-1, 2).astype(np.uint16)


@pytest.mark.slow
@given(nps.arrays(np.int64, st.tuples(st.integers(3, 8), st.just(2)), elements=st.integers(-8, 34)))
@settings(max_examples=300, deadline=None)
def test_polygon_by_the_even_odd_rule(halves: np.ndarray) -> None:
    exact = [[Fraction(int(v), 2) for v in vertex] for vertex in halves]
    wanted = [lies_in(int(row), int(col), exact) for row, col in GRID]
    np.testing.assert_array_equal(in_outline(GRID, halves / 2), wanted)


def test_polygon_of_a_cloud(path: Path) -> None:
    cloud = Cloud.open(path)
    outline = [(10.5, 3.0), (40.0, 8.0), (33.0, 50.5), (20.0, 20.0), (5.0, 45.0)]
    wanted = np.flatnonzero(in_outline(cloud.hsi_pixel, np.array(outline)))
    assert 200 < len(wanted) < cloud.n_points / 2
    np.testing.assert_array_equal(cloud.in_polygon(outline), wanted)
    everything = [(-1e6, -1e6), (-1e6, 1e6), (1e6, 1e6), (1e6, -1e6)]
    np.testing.assert_array_equal(cloud.in_polygon(everything), np.arange(cloud.n_points))
    assert len(cloud.in_polygon([(900, 0), (900, 9), (950, 5)])) == 0
    assert len(cloud.in_polygon([(-9, 0), (-9, 9), (-2, 5)])) == 0


def test_many_pixels_at_once(path: Path) -> None:
    cloud = Cloud.open(path)
    grid = np.moveaxis(np.mgrid[-2:75, -2:60], 0, -1).reshape(-1, 2)
    by_pixel = {tuple(pixel): i for i, pixel in enumerate(cloud.hsi_pixel.tolist())}
    wanted = [by_pixel.get(tuple(pixel), -1) for pixel in grid.tolist()]
    np.testing.assert_array_equal(cloud.at_pixels(grid), wanted)
    np.testing.assert_array_equal(cloud.at_pixels(np.array([[70000, 0], [0, 65536 + 5]])), [-1, -1])


# ---- other sources --------------------------------------------------------------------------------------


class AwayError(SpecimapError, RuntimeError):
    """What a store raises that does not answer."""

    code = "away"


class InMemory:
    """A group in memory, which counts what is read."""

    name = "memory"

    def __init__(self, folder: Path) -> None:
        self.files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        self.read_bytes = 0
        self.error: Exception | None = None

    def size(self, key: str) -> int:
        return len(self._file(key))

    def read(self, key: str, start: int = 0, stop: int | None = None) -> bytes:
        piece = self._file(key)[start:stop]
        self.read_bytes += len(piece)
        return piece

    def _file(self, key: str) -> bytes:
        if self.error:
            raise self.error
        if key not in self.files:
            raise NotFoundError(f"no {key}")
        return self.files[key]


def test_another_source_reads_alike(path: Path) -> None:
    source, here = InMemory(path), Cloud.open(path)
    cloud = Cloud.open(source)
    points = [5, 2900, 17]
    np.testing.assert_array_equal(cloud.spectra(points), here.spectra(points))
    np.testing.assert_array_equal(cloud.band(4), here.band(4))
    np.testing.assert_array_equal(cloud.in_radius([2, -2, 0], 1), here.in_radius([2, -2, 0], 1))
    assert (cloud.attributes, cloud.label_names) == (here.attributes, ())
    with pytest.raises(ValueError, match="not in a folder"):
        _ = cloud.path
    assert here.path == path


def test_one_spectrum_reads_one_chunk(path: Path) -> None:
    source = InMemory(path)
    cloud = Cloud.open(source)
    cloud.spectra([0])
    before, whole = source.read_bytes, len(source.files["spectra/c/0/0"])
    cloud.spectra([300])
    # Twelve chunks; their index is known by now.
    assert 0 < source.read_bytes - before < whole / 5


def test_kept_bytes_grow_with_what_is_read(path: Path) -> None:
    cloud = Cloud.open(path)
    assert cloud.kept_bytes == 0
    cloud.spectra([0])
    assert cloud.kept_bytes == 0
    assert cloud.xyz.nbytes + cloud.rgb.nbytes == cloud.kept_bytes == 15 * cloud.n_points


def test_missing_and_broken_files_are_damage_but_a_store_that_is_away_is_not(path: Path) -> None:
    source = InMemory(path)
    cloud = Cloud.open(source)
    source.error = AwayError("away")
    with pytest.raises(AwayError):
        cloud.spectra([0])
    with pytest.raises(AwayError):
        Cloud.open(source)
    source.error = None
    shard = source.files.pop("spectra/c/0/0")
    with pytest.raises(CloudDamagedError):
        cloud.spectra([0])
    source.files["spectra/c/0/0"] = shard[:100]
    with pytest.raises(CloudDamagedError, match="truncated"):
        cloud.spectra([0])
    del source.files["xyz/zarr.json"]
    with pytest.raises(CloudDamagedError, match="lacks the arrays xyz"):
        Cloud.open(source)
    source.files["zarr.json"] = b"[]"
    with pytest.raises(CloudDamagedError):
        Cloud.open(source)
    del source.files["zarr.json"]
    with pytest.raises(NotFoundError):
        Cloud.open(source)


def test_a_foreign_layout_is_refused_away_from_a_folder(path: Path) -> None:
    source = InMemory(path)
    source.files["rgb/zarr.json"] = source.files["rgb/zarr.json"].replace(b"sharding_indexed", b"something_else")
    with pytest.raises(CloudDamagedError, match="not laid out"):
        Cloud.open(source)


def test_folder_reads_parts(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(bytes(range(100)))
    folder = Folder(tmp_path)
    assert folder.size("f") == 100
    assert folder.read("f", 10, 20) == bytes(range(10, 20))
    assert folder.read("f", 95, 200) == bytes(range(95, 100))
    assert folder.read("f") == bytes(range(100))

"""Exports hold what the cloud holds, as other readers see it."""

from __future__ import annotations

import csv
import errno
import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import spectral.io.envi
from numpy.typing import NDArray

from specimap_core.cloud import Cloud, CloudPoints
from specimap_core.cloud.top_view import top_view
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import SettingsError, StorageFullError
from specimap_core.export import EXPORTERS, ExportFormat, envi, export_cloud
from tests.support.cloud_scene import FakeCube, counts, scene

HOLDING = [format for format in EXPORTERS if format not in ("html", "pdf")]
"""Formats that hold the cloud; the others are the report on it, which tests/core/report/test_document.py is about."""


def make(path: Path, points: CloudPoints, cube: FakeCube) -> Cloud:
    write_cloud(path, points, cube, {"report": {"method": "camera"}})
    return Cloud.open(path)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Cloud:
    return make(tmp_path_factory.mktemp("export") / "c.zarr", scene(70, 53), FakeCube(counts(), bad=(2,)))


def test_ply(cloud: Cloud, tmp_path: Path) -> None:
    path = export_cloud(cloud, tmp_path / "cloud.ply", "ply")
    header, body = path.read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert f"element vertex {cloud.n_points}" in lines
    kinds = {"float": "<f4", "uchar": "u1"}
    layout = [(name, kinds[kind]) for _, kind, name in (x.split() for x in lines if x.startswith("property"))]
    vertices = np.frombuffer(body, np.dtype(layout))
    assert len(vertices) == cloud.n_points
    stacked = np.stack([vertices[k] for k in ("x", "y", "z")], 1)
    np.testing.assert_array_equal(stacked, cloud.xyz)
    np.testing.assert_array_equal(np.stack([vertices[k] for k in ("nx", "ny", "nz")], 1), cloud.normal)
    np.testing.assert_array_equal(np.stack([vertices[k] for k in ("red", "green", "blue")], 1), cloud.rgb)
    np.testing.assert_array_equal(vertices["sigma_mm"], cloud.sigma_mm)
    np.testing.assert_array_equal(vertices["flags"], cloud.flags)


def test_las(cloud: Cloud, tmp_path: Path) -> None:
    las = laspy.read(export_cloud(cloud, tmp_path / "cloud.las", "las"))
    assert str(las.header.version) == "1.4"
    assert las.header.point_format.id == 7
    assert np.abs(las.xyz - cloud.xyz).max() <= 0.00051
    assert np.abs(las.header.mins - cloud.xyz.min(0)).max() <= 0.00051
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], 1) // 257, cloud.rgb)
    np.testing.assert_array_equal(las["sigma_mm"], cloud.sigma_mm)
    np.testing.assert_array_equal(las["flags"], cloud.flags)
    np.testing.assert_array_equal(np.stack([las["hsi_row"], las["hsi_col"]], 1), cloud.hsi_pixel)


def test_npz(cloud: Cloud, tmp_path: Path) -> None:
    with np.load(export_cloud(cloud, tmp_path / "cloud.npz", "npz")) as held:
        np.testing.assert_array_equal(held["spectra"], cloud.stored_spectra(slice(None)))
        for name in ("xyz", "hsi_pixel", "normal", "rgb", "sigma_mm", "flags"):
            np.testing.assert_array_equal(held[name], getattr(cloud, name))
        np.testing.assert_array_equal(held["wavelength_nm"], cloud.wavelengths_nm)
        assert float(held["scale_factor"]) == 1e-4
        assert str(held["quantity"]) == "reflectance"
        assert json.loads(str(held["attributes"]))["report"] == {"method": "camera"}


def test_csv(cloud: Cloud, tmp_path: Path) -> None:
    path = export_cloud(cloud, tmp_path / "cloud.csv", "csv")
    with open(path, newline="", encoding="ascii") as file:
        header, *rows = csv.reader(file)
    assert header[:3] == ["x_mm", "y_mm", "z_mm"]
    assert [float(name) for name in header[13:]] == [400, 500, 600, 700, 800, 900, 1000]
    table = np.array(rows, float)
    assert table.shape == (cloud.n_points, 13 + 7)
    np.testing.assert_allclose(table[:, :3], cloud.xyz, atol=0.51e-4)
    np.testing.assert_array_equal(table[:, 6:9], cloud.rgb)
    np.testing.assert_array_equal(table[:, 10], cloud.flags)
    np.testing.assert_array_equal(table[:, 11:13], cloud.hsi_pixel)
    np.testing.assert_array_equal(np.rint(table[:, 13:] * 1e4), cloud.stored_spectra(slice(None)))


def test_csv_of_scaled_counts_without_wavelengths(tmp_path: Path) -> None:
    class Unknown(FakeCube):
        @property
        def wavelengths_nm(self) -> NDArray[np.float64]:
            return np.full(self.bands, np.nan)

    values = np.random.default_rng(0).uniform(-5, 2000, (20, 20, 3)).astype(np.float32)
    cloud = make(tmp_path / "c.zarr", scene(20, 20), Unknown(values, None, "counts"))
    with open(export_cloud(cloud, tmp_path / "cloud.csv", "csv"), encoding="ascii") as file:
        assert file.readline().strip().split(",")[13:] == ["band_0", "band_1", "band_2"]
        table = np.loadtxt(file, delimiter=",")
    row, col = cloud.hsi_pixel.astype(int).T
    assert np.abs(table[:, 13:] - values[row, col]).max() < 2005 / 65535


def brute_force(cloud: Cloud, grid_mm: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Mean spectra (rows, cols, B), rows growing with y, and which cells have points."""
    origin = cloud.xyz[:, :2].min(0)
    col, row = np.rint((cloud.xyz[:, :2] - origin) / np.float32(grid_mm)).astype(int).T
    spectra = cloud.stored_spectra(slice(None)).astype(float)
    means = np.zeros((row.max() + 1, col.max() + 1, cloud.bands))
    filled = np.zeros(means.shape[:2], bool)
    for r, c in set(zip(row.tolist(), col.tolist(), strict=True)):
        inside = (row == r) & (col == c)
        z = cloud.xyz[:, 2]
        means[r, c] = spectra[inside & (z >= z[inside].max() - 1)].mean(0)
        filled[r, c] = True
    return means, filled


@pytest.mark.parametrize(("grid_mm", "together"), [(0.5, 65536), (0.5, 50), (0.07, 300), (3.0, 7)])
def test_envi(cloud: Cloud, tmp_path: Path, grid_mm: float, together: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Small portions: the blocks that bound memory must not show in the file.
    monkeypatch.setattr(envi, "_POINTS_TOGETHER", together)
    path = export_cloud(cloud, tmp_path / "top.hdr", "envi", grid_mm=grid_mm)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["top.bil", "top.hdr"]
    opened = spectral.io.envi.open(str(path), str(path.with_suffix(".bil")))
    raw = np.asarray(opened.open_memmap(interleave="bip"))
    means, filled = brute_force(cloud, grid_mm)
    assert raw.shape == means.shape
    upward = raw[::-1]
    assert np.abs(upward[filled] - means[filled]).max() <= 0.51
    assert not upward[~filled].any()
    meta = opened.metadata
    assert meta["data ignore value"] == "0"
    assert float(meta["reflectance scale factor"]) == 10000
    assert [int(good) for good in meta["bbl"]] == [1, 1, 0, 1, 1, 1, 1]
    np.testing.assert_allclose([float(w) for w in meta["wavelength"]], cloud.wavelengths_nm, rtol=1e-5)
    # As GDAL reads `map info`: the reference pixel is 1-based, y falls with the line.
    _, ref_x, ref_y, x, y, step_x, step_y, *_ = meta["map info"]
    ref_col, ref_line = float(ref_x) - 1.5, float(ref_y) - 1.5
    assert (ref_col, ref_line) == (0, raw.shape[0] - 1)
    np.testing.assert_allclose([float(x), float(y)], cloud.xyz[:, :2].min(0), atol=1e-5)
    assert float(step_x) == float(step_y) == grid_mm


def test_what_is_seen_from_above() -> None:
    """An undercut: 3 mm below the flank, the lower sheet is hidden; 0.5 mm below it still counts."""
    points = scene(16, 32, share=1)
    row, col = points.hsi_pixel.astype(int).T
    xyz = points.xyz.copy()
    xyz[:, 0], xyz[:, 1] = col % 16 * 0.1, row * 0.1
    xyz[:, 2] = np.where(col < 16, 5.0, np.where(row < 8, 2.0, 4.5))

    class Held:
        chunk_aabb = np.concatenate([xyz.min(0), xyz.max(0)])[None]

    held = Held()
    held.xyz = xyz  # type: ignore[attr-defined]
    view = top_view(held, 0.1)  # type: ignore[arg-type]
    np.testing.assert_array_equal(view.top, (col < 16) | (row >= 8))
    assert (view.rows, view.cols) == (16, 16)


def test_envi_of_scaled_counts(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(50, 2000, (20, 20, 3)).astype(np.float32)
    cloud = make(tmp_path / "c.zarr", scene(20, 20), FakeCube(values, None, "counts"))
    path = export_cloud(cloud, tmp_path / "top", "envi", grid_mm=0.1)
    assert path == tmp_path / "top.hdr"
    meta = spectral.io.envi.read_envi_header(str(path))
    assert "reflectance scale factor" not in meta
    np.testing.assert_allclose([float(g) for g in meta["data gain values"]], cloud.scale_factor, rtol=1e-6)
    np.testing.assert_allclose([float(g) for g in meta["data offset values"]], cloud.add_offset, rtol=1e-6)


@pytest.mark.parametrize("grid_mm", [0.0, -1.0, float("nan"), float("inf"), 1e-5])
def test_impossible_grids(cloud: Cloud, tmp_path: Path, grid_mm: float) -> None:
    with pytest.raises(SettingsError) as caught:
        export_cloud(cloud, tmp_path / "top.hdr", "envi", grid_mm=grid_mm)
    assert caught.value.details["setting"] == "grid_mm"
    assert list(tmp_path.iterdir()) == []


def test_unknown_format(cloud: Cloud, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="obj"):
        export_cloud(cloud, tmp_path / "x", "obj")  # type: ignore[arg-type]


@pytest.mark.parametrize("format", HOLDING)
def test_exports_are_whole_or_absent(
    cloud: Cloud, tmp_path: Path, format: ExportFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "cloud.hdr"
    export_cloud(cloud, target, format)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    export_cloud(cloud, target, format)  # replaces it
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    broken = Cloud.open(cloud.path)
    monkeypatch.setattr(Cloud, "_whole", full)
    monkeypatch.setattr(Cloud, "iter_chunks", full)
    monkeypatch.setattr(Cloud, "stored_spectra", full)
    # What is read before the file is begun must be there already.
    for name in ("chunk_aabb", "wavelengths_nm", *(["xyz"] if format == "envi" else [])):
        vars(broken)[name] = getattr(cloud, name)
    if format == "npz":
        for name in ("xyz", "hsi_pixel", "normal", "rgb", "sigma_mm", "flags"):
            vars(broken)[name] = getattr(cloud, name)
    with pytest.raises(StorageFullError):
        export_cloud(broken, target, format)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_one_point(tmp_path: Path) -> None:
    one = CloudPoints(**{name: values[:1] for name, values in vars(scene(20, 20)).items()})
    cloud = make(tmp_path / "c.zarr", replace(one), FakeCube(counts(20, 20, 1)))
    for format in HOLDING:
        assert export_cloud(cloud, tmp_path / f"one.{format}", format).is_file()  # type: ignore[arg-type]

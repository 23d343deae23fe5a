"""Cubes of every other format against their truth; damaged files of all formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, CubeHeaderError, CubeTruncatedError, SpecimapError
from tests.support.cube_files import DTYPES, check_reads, random_values, write_envi

h5py = pytest.importorskip("h5py")
tifffile = pytest.importorskip("tifffile")
scipy_io = pytest.importorskip("scipy.io")

NM = np.linspace(400, 1000, 11)


@pytest.mark.parametrize("dtype", [*DTYPES, ">u2", ">f4", "f2", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path: Path, dtype: str, order: str) -> None:
    values = random_values(np.dtype(dtype).newbyteorder("=").str)
    np.save(tmp_path / "x.npy", np.array(values, dtype, order=order))  # type: ignore[call-overload]
    if dtype == "f2":  # its sums overflow in the reference below
        np.testing.assert_array_equal(open_cube(tmp_path / "x.npy").read_rows(0, 7), values)
    else:
        check_reads(open_cube(tmp_path / "x.npy"), values)


def test_npy_refusals(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, np.array([[[{}]]], object), allow_pickle=True)
    with pytest.raises(CubeHeaderError, match="object"):
        open_cube(path)
    np.save(path, np.zeros((2, 2, 2), complex))
    with pytest.raises(CubeHeaderError) as header:
        open_cube(path)
    assert header.value.details["field"] == "dtype"
    np.save(path, np.zeros((2, 2)))
    with pytest.raises(CubeFormatError):
        open_cube(path)
    np.save(path, np.zeros((4, 4, 4)))
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(CubeTruncatedError) as cut:
        open_cube(path)
    assert cut.value.details == {"expected_bytes": whole, "found_bytes": whole - 10}
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(CubeFormatError):
        open_cube(path)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npz(tmp_path: Path, packed: bool, order: str) -> None:
    values = random_values("u2")
    save = np.savez_compressed if packed else np.savez
    stored = values.copy(order="C" if order == "C" else "F")
    save(tmp_path / "x.npz", cube=stored, wavelengths=NM, other=np.zeros((2, 2, 2)))
    cube = open_cube(tmp_path / "x.npz")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    save(tmp_path / "y.npz", anything=stored)
    check_reads(open_cube(tmp_path / "y.npz"), values)
    save(tmp_path / "z.npz", one=stored, two=stored)
    with pytest.raises(CubeFormatError) as caught:
        open_cube(tmp_path / "z.npz")
    assert caught.value.details["variables"] == ["one", "two"]


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (3, 2, 4)}, {"chunks": (1, 5, 11), "compression": "gzip", "shuffle": True}]
)
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
@pytest.mark.parametrize("dtype", ["u2", ">f4", "i4"])
def test_hdf5(tmp_path: Path, options: dict[str, Any], axes: tuple[int, ...], dtype: str) -> None:
    values = random_values(np.dtype(dtype).newbyteorder("=").str)
    options = dict(options)
    if "chunks" in options:
        options["chunks"] = tuple(options["chunks"][a] for a in axes)
    with h5py.File(tmp_path / "x.h5", "w", userblock_size=512) as f:
        f.create_dataset("scan/cube", data=values.transpose(axes).astype(dtype), **options)
        f["scan/wavelength_um"] = NM / 1e3
    cube = open_cube(tmp_path / "x.h5")
    check_reads(cube, values)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)
    assert cube.warnings == ()


def test_hdf5_unpacked_where_chunks_do_not_suit_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = random_values("u2")
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f.create_dataset("cube", data=values.transpose(2, 0, 1), chunks=(1, 7, 5), compression="gzip")
        f["wavelength"] = NM
    monkeypatch.setattr("specimap_core.cube.hdf._LARGEST_CHUNK_ROW", 100)
    monkeypatch.setattr("specimap_core.cube.unpacked.IN_MEMORY_BYTES", 100)
    check_reads(open_cube(tmp_path / "x.h5"), values)


def test_hdf5_reflectance_scale_and_guessed_axes(tmp_path: Path) -> None:
    values = random_values("u2") // 6
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["Reflectance"] = values
        f["Reflectance"].attrs["Scale_Factor"] = 10000.0
    cube = open_cube(tmp_path / "x.h5")
    check_reads(cube, values)
    assert cube.to_reflectance == pytest.approx(1e-4)
    assert [w.code for w in cube.warnings] == ["axes_assumed", "wavelengths_missing"]


def test_hdf5_does_not_leave_its_file(tmp_path: Path) -> None:
    values = random_values("u1")
    (tmp_path / "secret").write_bytes(values.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as f:
        f["cube"] = values
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f.create_dataset("cube", values.shape, "u1", external=[(str(tmp_path / "secret"), 0, values.nbytes)])
    with h5py.File(tmp_path / "y.h5", "w") as f:
        f["cube"] = h5py.ExternalLink("other.h5", "/cube")
    with h5py.File(tmp_path / "z.h5", "w") as f:
        layout = h5py.VirtualLayout(values.shape, "u1")
        layout[...] = h5py.VirtualSource(str(tmp_path / "other.h5"), "cube", values.shape)
        f.create_virtual_dataset("cube", layout)
    for name in ("x.h5", "y.h5", "z.h5"):
        with pytest.raises(CubeFormatError):
            open_cube(tmp_path / name)


def test_hdf5_truncated(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as f:
        f["cube"] = random_values("f8")
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CubeTruncatedError) as caught:
        open_cube(path)
    assert caught.value.details == {"expected_bytes": whole, "found_bytes": whole - 100}


@pytest.mark.parametrize("options", [{}, {"chunks": (4, 5, 3), "compression": "gzip"}])
def test_matlab73(tmp_path: Path, options: dict[str, Any]) -> None:
    values = random_values("u2")
    with h5py.File(tmp_path / "x.mat", "w", userblock_size=512) as f:
        f.create_dataset("cube", data=values.T, **options).attrs["MATLAB_class"] = np.bytes_("uint16")
        f.create_dataset("wavelengths", data=NM[None]).attrs["MATLAB_class"] = np.bytes_("double")
    cube = open_cube(tmp_path / "x.mat")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    assert cube.format_name == "MATLAB 7.3"


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("packed", [False, True])
def test_matlab5(tmp_path: Path, dtype: str, packed: bool) -> None:
    values = random_values(dtype)
    content = {"note": "text", "img": values, "wl": NM, "gt": np.zeros((7, 5)), "s": {"a": [1, 2]}, "z": 1j}
    scipy_io.savemat(tmp_path / "x.mat", content, do_compression=packed)
    cube = open_cube(tmp_path / "x.mat")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    assert cube.warnings == ()


@pytest.mark.parametrize("dtype", ["i2", "i4", "f4", "f8"])
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
def test_netcdf3(tmp_path: Path, dtype: str, axes: tuple[int, ...]) -> None:
    values = random_values(dtype)
    with scipy_io.netcdf_file(tmp_path / "x.nc", "w") as f:
        for name, size in zip(("y", "x", "band"), values.shape, strict=True):
            f.createDimension(name, size)
        f.createVariable("data", dtype, tuple(("y", "x", "band")[a] for a in axes))[:] = values.transpose(axes)
        wavelength = f.createVariable("wavelength", "f8", ("band",))
        wavelength[:] = NM / 1e3
        wavelength.units = "micrometers"
    cube = open_cube(tmp_path / "x.nc")
    check_reads(cube, values)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4"])
@pytest.mark.parametrize("layout", ["pages", "contig", "planar", "packed", "separate"])
@pytest.mark.parametrize("order", "<>")
def test_tiff(tmp_path: Path, dtype: str, layout: str, order: str) -> None:
    values = random_values(dtype)
    path = tmp_path / "x.tif"
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    if layout == "separate":
        with tifffile.TiffWriter(path, byteorder=order) as writer:
            for page in pages:
                writer.write(page, photometric="minisblack", contiguous=False, metadata=None)
    elif layout == "contig":
        tifffile.imwrite(path, values, photometric="minisblack", planarconfig="contig", byteorder=order)
    elif layout == "planar":
        tifffile.imwrite(path, pages, photometric="minisblack", planarconfig="separate", byteorder=order)
    else:
        packing = "zlib" if layout == "packed" else None
        tifffile.imwrite(
            path,
            pages,
            photometric="minisblack",
            compression=packing,
            byteorder=order,
            metadata={"wavelengths": NM.tolist()},
        )
    cube = open_cube(path)
    check_reads(cube, values)
    if layout in ("pages", "packed"):
        np.testing.assert_allclose(cube.wavelengths_nm, NM)


def test_tiff_truncated(tmp_path: Path) -> None:
    path = tmp_path / "x.tif"
    pages = random_values("u2", (40, 30, 11)).transpose(2, 0, 1)
    tifffile.imwrite(path, pages, photometric="minisblack", metadata=None)
    whole = path.read_bytes()
    with tifffile.TiffWriter(path) as writer:
        for page in pages:
            writer.write(page, photometric="minisblack", contiguous=False, metadata=None)
    for content in (whole, path.read_bytes()):
        for kept in (0.3, 0.5, 0.8):
            path.write_bytes(content[: int(kept * len(content))])
            with pytest.raises(CubeTruncatedError):
                open_cube(path)


@pytest.mark.parametrize("name", ["x.npy", "x.npz", "x.h5", "x.nc", "x.mat", "x.tif", "x.raw", "x.hdr"])
def test_damaged_files_are_refused_or_read(tmp_path: Path, name: str) -> None:
    """Cut and bit-flipped files end in a typed error, never in another exception."""
    values = random_values("i2")
    whole = tmp_path / name
    if name == "x.npy":
        np.save(whole, values)
    elif name == "x.npz":
        np.savez_compressed(whole, cube=values, wavelengths=NM)
    elif name == "x.h5":
        with h5py.File(whole, "w") as f:
            f.create_dataset("cube", data=values, chunks=(2, 5, 11), compression="gzip")
    elif name == "x.nc":
        with scipy_io.netcdf_file(whole, "w") as f:
            for axis, size in zip("yxb", values.shape, strict=True):
                f.createDimension(axis, size)
            f.createVariable("data", "i2", tuple("yxb"))[:] = values
    elif name == "x.mat":
        scipy_io.savemat(whole, {"cube": values}, do_compression=True)
    elif name == "x.tif":
        tifffile.imwrite(whole, values.transpose(2, 0, 1), photometric="minisblack")
    else:
        write_envi(tmp_path / "x.hdr", values, wavelength="{" + ",".join(map(str, NM)) + "}")
    content = whole.read_bytes()
    rng = np.random.default_rng(5)
    refused = 0
    for trial in range(60):
        damaged = bytearray(content[: rng.integers(1, len(content))] if trial % 2 else content)
        for at in rng.integers(0, min(len(damaged), 2000), 8):
            damaged[at] ^= 1 << int(rng.integers(0, 8))
        whole.write_bytes(damaged)
        try:
            cube = open_cube(whole)
            cube.read_rows(0, cube.rows)
        except SpecimapError:
            refused += 1
    assert refused >= 15, refused

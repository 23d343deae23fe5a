"""Which of several arrays is the cube, which of its axes is which, and how a user names another."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from scipy import io as scipy_io

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, CubeHeaderError, SpecimapError
from tests.support.cube_files import check_reads, random_values, write_envi
from tests.support.notices import messages

NM = np.linspace(400, 1000, 11)
COUNTS = random_values("u2")
SHARE = np.random.default_rng(3).random((7, 5, 11)).astype("f4")
Arrays = dict[str, Any]


def hdf5(folder: Path, arrays: Arrays) -> Path:
    with h5py.File(folder / "x.h5", "w") as f:
        for name, values in arrays.items():
            f[name] = values
    return folder / "x.h5"


def netcdf4(folder: Path, arrays: Arrays) -> Path:
    """As netCDF4 writes it: groups, with dimension scales that name the axes."""
    with h5py.File(folder / "x.nc", "w") as f:
        for axis, size in (("line", 7), ("sample", 5), ("wavelength_axis", 11)):
            f[axis] = np.zeros(size, "f4")
            f[axis].make_scale(axis)
        for name, values in arrays.items():
            f[name] = values
            if np.ndim(values) == 3:
                for i, axis in enumerate(("line", "sample", "wavelength_axis")):
                    f[name].dims[i].attach_scale(f[axis])
    return folder / "x.nc"


def npz(folder: Path, arrays: Arrays) -> Path:
    np.savez(folder / "x.npz", **arrays)
    return folder / "x.npz"


def matlab5(folder: Path, arrays: Arrays) -> Path:
    scipy_io.savemat(folder / "x.mat", nested(arrays))
    return folder / "x.mat"


def nested(arrays: Arrays) -> Arrays:
    """``a/b`` as the field b of the struct a."""
    found: Arrays = {}
    for name, values in arrays.items():
        *groups, last = name.split("/")
        place = found
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = values
    return found


Writer = Callable[[Path, Arrays], Path]
CONTAINERS: list[Writer] = [hdf5, netcdf4, npz, matlab5]


@pytest.mark.parametrize("write", CONTAINERS)
@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (("L0/cube", "L1/reflectance"), "L1/reflectance"),
        (("L1/reflectance", "L0/cube"), "L1/reflectance"),
        (("cube", "Reflectance_Data"), "Reflectance_Data"),
        (("raw/data", "white_reference/reflectance"), "raw/data"),
        (("L1/reflectance", "L1/reflectance_error"), "L1/reflectance"),
        (("calibrated/cube", "calibration/cube"), "calibrated/cube"),
        (("spectra", "anything"), "spectra"),
    ],
)
def test_reflectance_comes_first_and_the_choice_is_said(
    tmp_path: Path, write: Writer, names: tuple[str, str], taken: str
) -> None:
    other = next(n for n in names if n != taken)
    path = write(tmp_path, {n: SHARE if n == taken else COUNTS for n in names} | {"wavelengths": NM})
    cube = open_cube(path)
    check_reads(cube, SHARE)
    text = messages(cube.warnings)["dataset_chosen"]
    assert f"'{taken}' (" in text
    assert text.index(f"'{taken}'") < text.index(f"not '{other}'")
    assert "--cube FILE::DATASET" in text
    for wanted in (other, f"/{other}", other.upper()):
        chosen = open_cube(Path(f"{path}::{wanted}"))
        check_reads(chosen, COUNTS)
        assert "dataset_chosen" not in messages(chosen.warnings)
        assert chosen.path == path
        assert chosen.fingerprint() != cube.fingerprint()


@pytest.mark.parametrize("write", [hdf5, npz, matlab5])
def test_the_one_as_long_as_the_wavelengths(tmp_path: Path, write: Writer) -> None:
    path = write(tmp_path, {"first": COUNTS, "second": COUNTS[:3, :4, :2], "wavelengths": NM})
    cube = open_cube(path)
    check_reads(cube, COUNTS)
    assert "'first'" in messages(cube.warnings)["dataset_chosen"]


@pytest.mark.parametrize("write", CONTAINERS)
def test_nothing_tells(tmp_path: Path, write: Writer) -> None:
    path = write(tmp_path, {"a/one": COUNTS, "a/two": SHARE, "wavelengths": NM})
    with pytest.raises(CubeFormatError, match="several") as caught:
        open_cube(path)
    assert "::DATASET" in caught.value.advice
    for part in ("'a/one'", "'a/two'", "7", "5", "11"):
        assert part in caught.value.message
    check_reads(open_cube(Path(f"{path}::a/two")), SHARE)
    check_reads(open_cube(Path(f"{path}::two")), SHARE)
    for wanted, word in (("three", "no array"), ("wavelengths", "three axes"), ("", "no array")):
        with pytest.raises(CubeFormatError, match=word) as caught:
            open_cube(Path(f"{path}::{wanted}"))
        assert "'a/one'" in caught.value.message


def test_no_array_with_three_axes_is_named_with_its_axes(tmp_path: Path) -> None:
    path = netcdf4(tmp_path, {"flat": COUNTS[..., 0], "deep": COUNTS[None]})
    with pytest.raises(CubeFormatError, match=r"'flat' \(7, 5\)"):
        open_cube(path)
    np.savez(tmp_path / "x.npz", flat=COUNTS[..., 0])
    with pytest.raises(CubeFormatError, match=r"'flat' \(7, 5\)"):
        open_cube(tmp_path / "x.npz")
    with h5py.File(tmp_path / "y.h5", "w") as f:
        f.create_dataset("table", (3, 4, 5), [("wavelength", "f8"), ("value", "u2")])
    with pytest.raises(CubeHeaderError, match="table"):
        open_cube(tmp_path / "y.h5")
    with pytest.raises(CubeHeaderError, match="table"):
        open_cube(Path(f"{tmp_path}/y.h5::table"))


def test_wavelengths_beside_the_cube_come_first(tmp_path: Path) -> None:
    for order in ((0, 1), (1, 0)):
        arrays = [("L0", COUNTS, NM + 50), ("L1", SHARE, NM)]
        with h5py.File(tmp_path / "x.h5", "w") as f:
            for i in order:
                group, values, wavelengths = arrays[i]
                f[f"{group}/{'cube' if group == 'L0' else 'reflectance'}"] = values
                f[f"{group}/wavelengths"] = wavelengths
        np.testing.assert_array_equal(open_cube(tmp_path / "x.h5").wavelengths_nm, NM)
        np.testing.assert_array_equal(open_cube(Path(f"{tmp_path}/x.h5::L0/cube")).wavelengths_nm, NM + 50)


# ---- FILE::DATASET ---------------------------------------------------------------------------------------


def test_references_in_the_same_file(tmp_path: Path) -> None:
    raw, white, dark = (np.full((4, 3, 2), v, "u2") for v in (300, 500, 100))
    raw[0] = 400
    path = hdf5(tmp_path, {"scan/raw": raw, "scan/white": white, "scan/dark": dark})
    cube = open_cube(Path(f"{path}::scan/raw"), white=Path(f"{path}::scan/white"), dark=Path(f"{path}::scan/dark"))
    np.testing.assert_allclose(cube.read_rows(0, 2)[:, 0, 0], [0.75, 0.5])
    turned = open_cube(Path(f"{path}::scan/raw"), white=Path(f"{path}::scan/raw"), dark=Path(f"{path}::scan/dark"))
    assert turned.fingerprint() != cube.fingerprint()


def test_a_file_whose_name_holds_colons(tmp_path: Path) -> None:
    folder = tmp_path / "a::b"
    folder.mkdir()
    path = hdf5(folder, {"one": COUNTS, "two": SHARE, "wavelengths": NM})
    named = path.rename(folder / "x::one.h5")
    check_reads(open_cube(Path(f"{named}::two")), SHARE)
    check_reads(open_cube(Path(f"{named}::one")), COUNTS)
    np.save(folder / "p::q.npy", SHARE)
    check_reads(open_cube(folder / "p::q.npy"), SHARE)
    with pytest.raises(FileNotFoundError, match="none"):
        open_cube(tmp_path / "none.h5::cube")


@pytest.mark.parametrize("name", ["x.npy", "x.tif", "x.hdr", "x.raw"])
def test_a_file_of_one_array_takes_no_name(tmp_path: Path, name: str) -> None:
    write_envi(tmp_path / "x.hdr", COUNTS)
    np.save(tmp_path / "x.npy", COUNTS)
    tifffile.imwrite(tmp_path / "x.tif", COUNTS.transpose(2, 0, 1), photometric="minisblack")
    with pytest.raises(CubeFormatError, match="one cube"):
        open_cube(Path(f"{tmp_path / name}::cube"))


# ---- axes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
@pytest.mark.parametrize("write", [hdf5, npz, matlab5])
def test_bands_by_the_wavelengths_length(tmp_path: Path, write: Writer, axes: tuple[int, int, int]) -> None:
    cube = open_cube(write(tmp_path, {"cube": COUNTS.transpose(axes), "wavelengths": NM}))
    check_reads(cube, COUNTS)
    assert cube.warnings == ()


def test_tiff_whose_pages_are_rows(tmp_path: Path) -> None:
    told = {"wavelengths": NM.tolist()}
    tifffile.imwrite(tmp_path / "x.tif", COUNTS, photometric="minisblack", metadata=told)
    cube = open_cube(tmp_path / "x.tif")
    check_reads(cube, COUNTS)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)
    assert [w.code for w in cube.warnings] == ["axes_assumed"]


def test_npy_that_looks_turned_is_said(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", np.zeros((3, 50, 60), "u1"))
    assert "3 rows x 50 columns x 60 bands" in messages(open_cube(tmp_path / "x.npy").warnings)["axes_assumed"]
    np.save(tmp_path / "y.npy", np.zeros((50, 60, 3), "u1"))
    assert "axes_assumed" not in messages(open_cube(tmp_path / "y.npy").warnings)


@pytest.mark.parametrize("names", [("x", "y"), ("samples", "lines"), ("longitude", "latitude"), ("cols", "rows")])
def test_columns_before_rows(tmp_path: Path, names: tuple[str, str]) -> None:
    with h5py.File(tmp_path / "x.nc", "w") as f:
        f["data"] = COUNTS.transpose(1, 0, 2)
        f["wavelengths"] = NM
        for i, label in enumerate((*names, "bands")):
            f["data"].dims[i].label = label
    check_reads(open_cube(tmp_path / "x.nc"), COUNTS)


def test_names_and_lengths_that_disagree(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.nc", "w") as f:
        f["data"], f["wavelengths"] = COUNTS, NM
        for i, label in enumerate(("band", "y", "x")):
            f["data"].dims[i].label = label
    cube = open_cube(tmp_path / "x.nc")
    check_reads(cube, COUNTS)
    assert "11 wavelengths" in messages(cube.warnings)["axes_assumed"]


# ---- MATLAB 5 --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("order", ["C", "F"])
def test_matlab5_struct(tmp_path: Path, packed: bool, order: str) -> None:
    content = {
        "note": "x" * 3000,
        "scan": {
            "empty": np.zeros((0, 0)),
            "words": "text",
            "wavelengths": NM,
            "unit": 1j,
            "units": "nm",
            "deep": {"er": {"Img": COUNTS.copy(order="F" if order == "F" else "C")}},
            "small": np.uint8(3),
        },
    }
    scipy_io.savemat(tmp_path / "x.mat", content, do_compression=packed)
    cube = open_cube(tmp_path / "x.mat")
    check_reads(cube, COUNTS)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    assert cube.warnings == ()
    check_reads(open_cube(Path(f"{tmp_path}/x.mat::scan/deep/er/Img")), COUNTS)


@pytest.mark.parametrize("packed", [False, True])
def test_matlab5_cells_and_struct_arrays(tmp_path: Path, packed: bool) -> None:
    cells = np.empty((1, 3), object)
    cells[0] = [COUNTS, "text", NM]
    structs = np.zeros((1, 2), [("cube", "O"), ("wavelengths", "O")])
    structs[0, 0] = (COUNTS, NM)
    structs[0, 1] = (SHARE, NM + 1)
    scipy_io.savemat(tmp_path / "x.mat", {"c": cells}, do_compression=packed)
    check_reads(open_cube(tmp_path / "x.mat"), COUNTS)
    scipy_io.savemat(tmp_path / "y.mat", {"s": structs}, do_compression=packed)
    with pytest.raises(CubeFormatError, match=r"'s\(2\)/cube'"):
        open_cube(tmp_path / "y.mat")
    second = open_cube(Path(f"{tmp_path}/y.mat::s(2)/cube"))
    check_reads(second, SHARE)
    np.testing.assert_array_equal(second.wavelengths_nm, NM + 1)


@pytest.mark.parametrize("packed", [False, True])
def test_matlab5_damaged_structs(tmp_path: Path, packed: bool) -> None:
    path = tmp_path / "x.mat"
    content = {"scan": {"wavelengths": NM, "cube": COUNTS, "list": np.array([1, "a", 2.5], object)}}
    scipy_io.savemat(path, content, do_compression=packed)
    whole = path.read_bytes()
    rng = np.random.default_rng(7)
    refused = 0
    for trial in range(400):
        damaged = bytearray(whole[: rng.integers(1, len(whole))] if trial % 3 == 0 else whole)
        for at in rng.integers(100, max(101, min(len(damaged), 600)), 4):
            if at < len(damaged):
                damaged[at] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            cube = open_cube(path)
            cube.read_rows(0, cube.rows)
        except SpecimapError:
            refused += 1
    assert refused > 200


def test_hdf5_with_types_that_numpy_does_not_know(tmp_path: Path) -> None:
    path = hdf5(tmp_path, {"cube": COUNTS, "wavelengths": NM})
    with h5py.File(path, "r+") as f:
        space = h5py.h5s.create_simple((3, 3, 3))
        h5py.h5d.create(f.id, b"times", h5py.h5t.UNIX_D32LE, space)
        h5py.h5a.create(f["cube"].id, b"when", h5py.h5t.UNIX_D32LE, h5py.h5s.create(h5py.h5s.SCALAR))
        f["enum"] = np.ones((2, 2, 2), bool)
        f["words"] = ["a", "b"]
        f["empty"] = h5py.Empty("f8")
    check_reads(open_cube(path), COUNTS)


def test_names_from_a_file_move_no_cursor(tmp_path: Path) -> None:
    bad = "a\x1b[31m\n" + "b" * 5000
    path = hdf5(tmp_path, {bad: COUNTS, "two": COUNTS, "wavelengths": NM})
    with pytest.raises(CubeFormatError) as caught:
        open_cube(path)
    words = str(caught.value) + repr(caught.value.details)
    with h5py.File(path, "r+") as f:
        f["reflectance"] = COUNTS
        f["wavelengths"].attrs["units"] = bad
    words += repr(open_cube(path).warnings)
    header = write_envi(tmp_path / "x.hdr", COUNTS)
    for line in (f"interleave = {bad[:6]}", f"data type = {bad[:6]}", f"wavelength = {{{bad[:6]}}}"):
        header.write_text(f"{header.read_text()}{line}\n")
        with pytest.raises(CubeHeaderError) as wrong:
            open_cube(header)
        words += str(wrong.value)
    assert "\x1b" not in words
    assert "\\x1b" not in words
    assert len(words) < 6000

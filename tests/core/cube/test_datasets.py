"""Which of several arrays is the cube, and how a user names another."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, CubeHeaderError
from tests.support.cube_files import check_reads, write_envi
from tests.support.dataset_files import CONTAINERS, COUNTS, NM, SHARE, Writer, hdf5, matlab5, netcdf4, npz
from tests.support.notices import messages


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

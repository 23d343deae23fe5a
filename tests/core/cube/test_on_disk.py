"""Cubes as they lie on a disk: names, companions, permissions, encodings, and what is no file at all."""

from __future__ import annotations

import gzip
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from scipy import io as scipy_io

from specimap_core.cube import open_cube
from specimap_core.errors import (
    CubeFormatError,
    CubeHeaderError,
    CubeNotFoundError,
    CubeNotReadableError,
    CubeTruncatedError,
)
from tests.support.cube_files import check_reads, random_values, write_envi

VALUES = random_values("u2")
NOBODY = 65534


# ---- names next to a header -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("x.hdr", "x.hyspex"),
        ("x.hdr", "x.HYSPEX"),
        ("X.HDR", "x.Raw"),
        ("x.raw.hdr", "x.raw"),
        ("x.HDR", "x.cube"),
        ("x.hdr", "x.anything"),
        ("x.v2.hdr", "x.v2.hyspex"),
        ("x.hyspex.hdr", "x.hyspex"),
        ("x.hdr", "x.float32"),
        ("x y (1).hdr", "x y (1).LAN"),
    ],
)
def test_whatever_the_header_stands_beside(tmp_path: Path, header: str, data: str) -> None:
    made = write_envi(tmp_path / "made.hdr", VALUES)
    made.with_suffix(".raw").rename(tmp_path / data)
    made.rename(tmp_path / header)
    for beside in ("x.png", "x.txt", "x.xml", "x.hdr.bak", "y.anything"):
        (tmp_path / beside).write_bytes(bytes(VALUES.nbytes))
    for given in (header, data):
        cube = open_cube(tmp_path / given)
        check_reads(cube, VALUES)
        assert {p.name for p in cube.files} == {header, data}


def test_an_unknown_suffix_must_hold_what_the_header_asks_for(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", VALUES)
    data = path.with_suffix(".raw").read_bytes()
    path.with_suffix(".raw").unlink()
    (tmp_path / "x.what").write_bytes(data + b"1")
    with pytest.raises(CubeNotFoundError):
        open_cube(path)
    (tmp_path / "x.what").write_bytes(data)
    check_reads(open_cube(path), VALUES)
    (tmp_path / "x.ever").write_bytes(bytes(len(data)))  # two that fit: nothing tells which it is
    with pytest.raises(CubeNotFoundError):
        open_cube(path)
    (tmp_path / "x.raw").write_bytes(data[:-1])
    with pytest.raises(CubeTruncatedError):
        open_cube(path)


def test_compressed_data_of_an_unknown_suffix(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", VALUES, compress=True)
    path.with_suffix(".raw").rename(tmp_path / "x.packed")
    check_reads(open_cube(path), VALUES)
    assert gzip.decompress((tmp_path / "x.packed").read_bytes()) != b""


def test_data_that_a_link_leads_to(tmp_path: Path) -> None:
    """A user may keep large data elsewhere."""
    path = write_envi(tmp_path / "x.hdr", VALUES)
    (tmp_path / "big").mkdir()
    path.with_suffix(".raw").rename(tmp_path / "big" / "scan")
    path.with_suffix(".raw").symlink_to(tmp_path / "big" / "scan")
    check_reads(open_cube(path), VALUES)


# ---- encodings -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "encoding"),
    [
        (b"\xff\xfe", "utf-16-le"),
        (b"\xfe\xff", "utf-16-be"),
        (b"", "utf-16-le"),
        (b"", "utf-16-be"),
        (b"\xef\xbb\xbf", "utf-8"),
        (b"", "latin-1"),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_encodings_of_the_header(tmp_path: Path, start: bytes, encoding: str, newline: str) -> None:
    path = write_envi(tmp_path / "x.hdr", VALUES, wavelength="{" + ",".join(map(str, range(400, 411))) + "}")
    text = path.read_text() + "description = { Gewebe, Größe in µm }\nwavelength units = nm\n"
    path.write_bytes(start + text.replace("\n", newline).encode(encoding))
    for given in (path, path.with_suffix(".raw")):
        cube = open_cube(given)
        check_reads(cube, VALUES)
        assert cube.wavelengths_nm[0] == 400


def test_text_that_is_no_header(tmp_path: Path) -> None:
    for content in ("ENV\n".encode("utf-16"), b"\xff\xfe", b"\xff\xfeE", "Envi\n".encode("utf-16-be"), bytes(40)):
        (tmp_path / "x.hdr").write_bytes(content)
        with pytest.raises(CubeHeaderError, match="not an ENVI header"):
            open_cube(tmp_path / "x.hdr")


# ---- permissions -----------------------------------------------------------------------------------------


@pytest.fixture
def nobody(tmp_path: Path) -> Iterator[None]:
    """An ordinary user, whom permissions bind."""
    if os.geteuid():
        yield
        return
    for folder in (tmp_path, *tmp_path.parents[:4]):
        if folder.name.startswith(("pytest-", "popen-", "test_")):
            folder.chmod(folder.stat().st_mode | 0o055)
    os.seteuid(NOBODY)
    try:
        if not os.access(tmp_path, os.R_OK | os.X_OK, effective_ids=True):
            pytest.skip("another user cannot reach the temporary folder")
        yield
    finally:
        os.seteuid(0)


def write_all(folder: Path) -> list[str]:
    write_envi(folder / "x.hdr", VALUES)
    np.save(folder / "x.npy", VALUES)
    np.savez(folder / "x.npz", cube=VALUES)
    with h5py.File(folder / "x.h5", "w") as f:
        f["cube"] = VALUES
    scipy_io.savemat(folder / "x.mat", {"cube": VALUES})
    with scipy_io.netcdf_file(folder / "x.nc", "w") as f:
        for name, size in zip("yxb", VALUES.shape, strict=True):
            f.createDimension(name, size)
        f.createVariable("data", "i2", tuple("yxb"))[:] = VALUES.astype("i2")
    tifffile.imwrite(folder / "x.tif", VALUES.transpose(2, 0, 1), photometric="minisblack")
    return ["x.hdr", "x.raw", "x.npy", "x.npz", "x.h5", "x.mat", "x.nc", "x.tif"]


@pytest.fixture
def locked(tmp_path: Path) -> Iterator[list[str]]:
    """Cubes of every format without read permission."""
    names = write_all(tmp_path)
    for name in names:
        (tmp_path / name).chmod(0)
    yield names
    for name in names:
        (tmp_path / name).chmod(0o600)


def test_files_without_read_permission(tmp_path: Path, locked: list[str], nobody: None) -> None:
    for name in locked:
        with pytest.raises(CubeNotReadableError, match="no permission") as caught:
            open_cube(tmp_path / name)
        assert caught.value.details["path"] == str(tmp_path / name)
        assert "permission" in caught.value.advice
        assert "damaged" not in str(caught.value)


@pytest.mark.parametrize("which", ["x.raw", "x.hdr"])
def test_one_of_two_files_without_read_permission(tmp_path: Path, which: str, request: pytest.FixtureRequest) -> None:
    path = write_envi(tmp_path / "x.hdr", VALUES)
    os.chmod(tmp_path / which, 0)
    request.getfixturevalue("nobody")
    for given in (path, path.with_suffix(".raw")):
        with pytest.raises(CubeNotReadableError, match=which):
            open_cube(given)


def test_a_folder_without_permission(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    folder = tmp_path / "closed"
    folder.mkdir()
    path = write_envi(folder / "x.hdr", VALUES)
    for mode in (0o000, 0o400, 0o111):
        folder.chmod(mode)
        if mode == 0:
            request.getfixturevalue("nobody")
        elif not os.getuid():
            os.seteuid(NOBODY)
        try:
            with pytest.raises(CubeNotReadableError):
                open_cube(path)
        finally:
            if not os.getuid():
                os.seteuid(0)
            folder.chmod(0o700)


# ---- what is no file -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["x", "x.hdr", "x.raw", "x.npy", "x.h5", "x.tif", "x.mat", "x.nc", "x.npz"])
def test_empty_files(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(CubeFormatError, match="empty"):
        open_cube(tmp_path / name)


def test_pipes_folders_sockets_and_lost_links(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "folder.hdr").mkdir()
    (tmp_path / "lost.npy").symlink_to(tmp_path / "none.npy")
    (tmp_path / "ring.npy").symlink_to(tmp_path / "ring.npy")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        for name, word in (("pipe.h5", "pipe"), ("folder.hdr", "folder"), ("s", "socket")):
            with pytest.raises(CubeFormatError, match=word):
                open_cube(tmp_path / name)
    for name in ("lost.npy", "ring.npy"):
        with pytest.raises(CubeNotFoundError, match="link"):
            open_cube(tmp_path / name)


def test_paths_that_no_file_can_have(tmp_path: Path) -> None:
    for name in ("x" * 3000, "a\0b", "x.npy/y.npy", "x::y"):
        with pytest.raises(CubeNotFoundError):
            open_cube(tmp_path / name)
    for name in ("::", "::cube"):
        with pytest.raises(CubeFormatError, match="folder"):
            open_cube(tmp_path / name)


def test_a_picture_beside_a_header_is_not_its_data(tmp_path: Path) -> None:
    write_envi(tmp_path / "x.hdr", VALUES)
    (tmp_path / "x.png").write_bytes(bytes(2 * VALUES.nbytes))
    with pytest.raises(CubeFormatError, match="no known cube format"):
        open_cube(tmp_path / "x.png")


@pytest.mark.parametrize("companion", ["fifo", "folder", "lost link"])
def test_companions_that_are_no_files(tmp_path: Path, companion: str) -> None:
    path = write_envi(tmp_path / "x.hdr", VALUES)
    for taken, other in ((".raw", ".hdr"), (".hdr", ".raw")):
        place = path.with_suffix(taken)
        kept = place.read_bytes()
        place.unlink()
        if companion == "fifo":
            os.mkfifo(place)
        elif companion == "folder":
            place.mkdir()
        else:
            place.symlink_to(tmp_path / "none")
        with pytest.raises((CubeNotFoundError, CubeFormatError)):
            open_cube(path.with_suffix(other))
        place.rmdir() if companion == "folder" else place.unlink()
        place.write_bytes(kept)
    check_reads(open_cube(path), VALUES)

"""No cube file of TIFF, ENVI, NumPy or MATLAB 5 makes its reader hand out another file."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from scipy import io as scipy_io

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError
from specimap_core.screening.cube import judge_cube
from tests.support.cube_files import write_envi
from tests.support.secret_file import NM, SECRET, SHAPE, VALUES, check_nothing_leaks

# ---- TIFF -----------------------------------------------------------------------------------------------


def ome(folder: Path, secret: Path, target: str) -> Path:
    """An OME-TIFF whose planes stand, it says, in another file."""
    path = folder / "x.ome.tif"
    planes = "".join(
        f'<TiffData FirstC="{c}" FirstZ="0" FirstT="0" IFD="{c}" PlaneCount="1">'
        f'<UUID FileName="{target}">urn:uuid:0000000{c % 10}-0000-0000-0000-000000000000</UUID></TiffData>'
        for c in range(11)
    )
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
        'UUID="urn:uuid:11111111-0000-0000-0000-000000000000"><Image ID="Image:0"><Pixels ID="Pixels:0" '
        'DimensionOrder="XYCZT" Type="double" SizeX="5" SizeY="7" SizeC="11" SizeZ="1" SizeT="1">'
        f"{planes}</Pixels></Image></OME>"
    )
    pages = np.ascontiguousarray(VALUES.transpose(2, 0, 1)).astype("f8")
    tifffile.imwrite(path, pages, photometric="minisblack", description=xml, metadata=None)
    return path


@pytest.mark.parametrize("target", ["{secret}/other.tif", "../secret/other.tif", "other.tif"])
def test_ome_tiff_reads_its_own_pages(tmp_path: Path, secret: Path, target: str) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "other.tif").write_bytes((secret / "other.tif").read_bytes())
    path = ome(folder, secret, target.format(secret=secret))
    assert check_nothing_leaks(path) is None
    np.testing.assert_array_equal(open_cube(path).read_rows(0, 7), VALUES)


@pytest.mark.parametrize("kind", ["micromanager", "ndtiff", "stk", "lsm", "scanimage", "mdgel", "binary_only"])
def test_tiff_of_many_files(tmp_path: Path, secret: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    path = folder / "x_MMStack_1.ome.tif"
    pages = np.ascontiguousarray(VALUES.transpose(2, 0, 1))
    tags: list[tuple[Any, ...]] = []
    description = ""
    if kind in ("micromanager", "ndtiff"):
        tags = [(51123, "s", 0, '{"Summary": {"Prefix": "x"}}', True)]
        (folder / "x_MMStack_2.ome.tif").write_bytes((secret / "other.tif").read_bytes())
        (folder / "NDTiff.index").write_bytes(
            struct.pack("<I", 2) + b"{}" + struct.pack("<I", 20) + b"../secret/other.tif\0" + bytes(32)
        )
    elif kind == "stk":
        tags = [(33629, "2I", 1, (1, 1), True)]
    elif kind == "lsm":
        tags = [(34412, "B", 500, bytes(500), True)]
    elif kind == "scanimage":
        description = "state.configPath='../secret'\rscanimage.SI.hChannels = 1"
    elif kind == "mdgel":
        tags = [(33445, "I", 1, 2, True)]
    else:
        description = (
            '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1">'
            f'<BinaryOnly MetadataFile="{secret}/other.tif" UUID="urn:uuid:2"/></OME>'
        )
    tifffile.imwrite(
        path, pages, photometric="minisblack", metadata=None, description=description or None, extratags=tags
    )
    opened: list[str] = []
    real = open

    def watched(file: Any, *args: Any, **kwargs: Any) -> Any:
        opened.append(os.fspath(file) if not isinstance(file, int) else "")
        return real(file, *args, **kwargs)

    monkeypatch.setattr("builtins.open", watched)
    assert check_nothing_leaks(path) is None
    assert {name for name in opened if str(tmp_path) in str(name)} == {str(path)}
    np.testing.assert_array_equal(open_cube(path).read_rows(0, 7), VALUES)


# ---- the others -----------------------------------------------------------------------------------------


def test_envi_header_names_nothing_outside_its_folder(tmp_path: Path, secret: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    values = np.resize(SECRET, SHAPE)
    for line in (f"data file = {secret / 'raw'}", "data file = ../secret/raw", "file name = ../secret/raw"):
        path = write_envi(folder / "x.hdr", values)
        path.write_text(f"{path.read_text()}{line}\n")
        path.with_suffix(".raw").unlink()
        assert check_nothing_leaks(path) is not None


@pytest.mark.parametrize("link", ["x.raw", "x.hdr", "x.npy"])
def test_links_to_other_files_are_not_judged(tmp_path: Path, secret: Path, link: str) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    path = write_envi(folder / "x.hdr", np.resize(SECRET, SHAPE))
    target = secret / f"other.{link[-3:]}"
    if link == "x.npy":
        np.save(target, np.resize(SECRET, SHAPE))
        path = folder / link
    else:
        (folder / link).rename(target)
    (folder / link).symlink_to(target)
    verdict = judge_cube(path)
    assert (verdict.verdict, verdict.code) == ("refused", "cube_format_unknown")
    assert "link" in verdict.reason
    assert not any(repr(float(value))[:9] in repr(verdict) for value in SECRET)


def test_npz_and_matlab_names_are_no_paths(tmp_path: Path, secret: Path) -> None:
    np.save(secret / "cube.npy", np.resize(SECRET, SHAPE))
    folder = tmp_path / "in"
    folder.mkdir()
    arrays: dict[str, Any] = {"../secret/cube": VALUES, str(secret / "wavelengths"): NM}
    np.savez(folder / "x.npz", **arrays)
    assert check_nothing_leaks(folder / "x.npz") is None
    scipy_io.savemat(folder / "x.mat", {"cube": VALUES, "wavelengths": NM, "file": str(secret / "cube.npy")})
    assert check_nothing_leaks(folder / "x.mat") is None


def test_a_chosen_data_set_is_no_path(tmp_path: Path, secret: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"] = VALUES
    for name in ("../secret/raw", str(secret / "other.h5"), "/../cube/", "cube/../cube"):
        with pytest.raises(CubeFormatError):
            open_cube(Path(f"{tmp_path}/x.h5::{name}"))

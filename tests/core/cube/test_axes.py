"""Which axis of an array is which, by its length, its names and its format."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from specimap_core.cube import open_cube
from tests.support.cube_files import check_reads
from tests.support.dataset_files import COUNTS, NM, Writer, hdf5, matlab5, npz
from tests.support.notices import messages


@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
@pytest.mark.parametrize("write", [hdf5, npz, matlab5])
def test_bands_by_the_wavelengths_length(tmp_path: Path, write: Writer, axes: tuple[int, int, int]) -> None:
    cube = open_cube(write(tmp_path, {"cube": COUNTS.transpose(axes), "wavelengths": NM}))
    check_reads(cube, COUNTS)
    assert cube.warnings == ()


def test_tiff_whose_pages_are_rows(tmp_path: Path) -> None:
    described = {"wavelengths": NM.tolist()}
    tifffile.imwrite(tmp_path / "x.tif", COUNTS, photometric="minisblack", metadata=described)
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

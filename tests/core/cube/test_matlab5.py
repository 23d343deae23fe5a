"""MATLAB 5 files: structs, cells, packed or not, and damaged ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import io as scipy_io

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, SpecimapError
from tests.support.cube_files import check_reads
from tests.support.dataset_files import COUNTS, NM, SHARE


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

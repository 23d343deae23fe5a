"""HDF5 files as programs other than h5py write them: names in other encodings, attributes of other types."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from specimap_core.cube import open_cube
from tests.support.cube_files import random_values

NM = np.linspace(400, 1000, 11)
COUNTS = random_values("u2", (7, 5, 11))


def check(path: Path, *, wavelengths: bool = True) -> None:
    cube = open_cube(path)
    assert np.array_equal(cube.read_rows(0, cube.rows), COUNTS)
    if wavelengths:
        assert np.allclose(cube.wavelengths_nm, NM)


def text(place: Any, name: bytes, value: bytes, charset: int) -> None:
    """A text of fixed length, as LabVIEW and MATLAB write them."""
    kind = h5py.h5t.C_S1.copy()
    kind.set_size(len(value))
    kind.set_cset(charset)
    made = h5py.h5a.create(place.id, name, kind, h5py.h5s.create(h5py.h5s.SCALAR))
    made.write(np.array(value, f"S{len(value)}"), mtype=kind)


@pytest.mark.parametrize("encoding", ["latin-1", "gbk", "shift-jis", "utf-8"])
def test_names_in_any_encoding(encoding: str, tmp_path: Path) -> None:
    word = ("Größe" if encoding in ("latin-1", "utf-8") else "数据").encode(encoding)
    with h5py.File(tmp_path / "x.h5", "w") as f:
        group = h5py.Group(h5py.h5g.create(f.id, word))
        group["cube"], group["wavelength"] = COUNTS, NM
        h5py.h5d.create(group.id, word, h5py.h5t.NATIVE_DOUBLE, h5py.h5s.create_simple((3,)))
        text(group["cube"], word, word, h5py.h5t.CSET_ASCII)
        text(group["cube"], b"long_name", word, h5py.h5t.CSET_UTF8)
    check(tmp_path / "x.h5")


@pytest.mark.parametrize("chunks", [None, (2, 5, 11)])
def test_a_cube_whose_own_name_is_not_utf8(chunks: tuple[int, ...] | None, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f.create_dataset("Würfel".encode("latin-1"), data=COUNTS, chunks=chunks)
        f["Wellenlänge wavelength".encode("latin-1")] = NM
    check(tmp_path / "x.h5")


OF_AXES: dict[str, tuple[str, Any]] = {
    "labels of fixed length": ("DIMENSION_LABELS", np.array([b"y", b"x", b"wavelength"])),
    "one text for all": ("DIMENSION_LABELS", "y, x, wavelength"),
    "a number": ("DIMENSION_LABELS", 5),
    "numbers": ("DIMENSION_LABELS", np.arange(3)),
    "too few labels": ("DIMENSION_LABELS", ["y", "x"]),
    "nothing": ("DIMENSION_LABELS", h5py.Empty("f4")),
    "a list that is a text": ("DIMENSION_LIST", "y, x, wavelength"),
    "a list of numbers": ("DIMENSION_LIST", np.arange(3)),
    "a list of labels": ("DIMENSION_LIST", ["y", "x", "wavelength"]),
}


def test_attributes_of_axes_of_any_type(tmp_path: Path) -> None:
    for case, (name, value) in OF_AXES.items():
        with h5py.File(tmp_path / f"{case}.h5", "w") as f:
            f["cube"], f["wavelength"] = COUNTS, NM
            f["cube"].attrs[name] = value
    # In a process of its own: HDF5 may crash it, after the last name that it prints.
    program = (
        "import pathlib, sys; from specimap_core.cube import open_cube\n"
        "for name in sys.argv[2:]: print(name, open_cube(pathlib.Path(sys.argv[1], f'{name}.h5')).rows, flush=True)"
    )
    command = [sys.executable, "-c", program, str(tmp_path), *OF_AXES]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.stdout.splitlines(), done.returncode) == ([f"{case} 7" for case in OF_AXES], 0), done.stderr


@pytest.mark.parametrize("fixed", [True, False])
def test_labels_of_axes_tell_which_is_which(fixed: bool, tmp_path: Path) -> None:
    labels: Any = ["wavelength", "y", "x"]
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"] = COUNTS.transpose(2, 0, 1)
        f["cube"].attrs["DIMENSION_LABELS"] = np.array([x.encode() for x in labels]) if fixed else labels
    check(tmp_path / "x.h5", wavelengths=False)


def test_a_scale_that_is_gone(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"], f["wavelength"], f["spare"] = COUNTS, NM, NM
        f["spare"].make_scale("lambda")
        f["cube"].dims[2].attach_scale(f["spare"])
        del f["spare"]
    check(tmp_path / "x.h5")


def test_a_text_of_units_is_small(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["cube"], f["wavelength"] = COUNTS, NM
        # 6 GB, of which the file holds nothing.
        f.create_dataset("wavelength_units", (60,), h5py.string_dtype("ascii", 100_000_000), chunks=(1,))
    check(tmp_path / "x.h5")

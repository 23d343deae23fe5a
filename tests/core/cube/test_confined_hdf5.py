"""No HDF5 file makes its reader hand out another file: each way out, in every role."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError
from tests.support.secret_file import NM, SHAPE, VALUES, check_nothing_leaks


def external_storage(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    size = int(np.prod(shape)) * 8
    f.create_dataset(name, shape, "f8", external=[(str(secret / "raw"), 0, size)])


def relative_storage(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    size = int(np.prod(shape)) * 8
    f.create_dataset(name, shape, "f8", external=[(os.path.join("..", "secret", "raw"), 0, size)])


def storage_with_prefix(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    size = int(np.prod(shape)) * 8
    f.create_dataset(name, shape, "f8", external=[("raw", 0, size)], efile_prefix=str(secret))


def external_link(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    f[name] = h5py.ExternalLink(str(secret / "other.h5"), "/cube" if len(shape) == 3 else "/vector")


def relative_link(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    f[name] = h5py.ExternalLink("../secret/other.h5", "/cube" if len(shape) == 3 else "/vector")


def soft_link_to_external(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    f["aside"] = h5py.ExternalLink(str(secret / "other.h5"), "/")
    f[name] = h5py.SoftLink("/aside/cube" if len(shape) == 3 else "/aside/vector")


def virtual(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource(secret / "other.h5", "cube" if len(shape) == 3 else "vector", shape)
    f.create_virtual_dataset(name, layout)


def endless_virtual(f: h5py.File, name: str, shape: tuple[int, ...], secret: Path) -> None:
    source = h5py.VirtualSource(secret / "other.h5", "vector", (11,), maxshape=(None,))
    layout = h5py.VirtualLayout((11,), "f8", maxshape=(None,))
    layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
    f.create_virtual_dataset(name, layout)


WAYS = [
    external_storage,
    relative_storage,
    storage_with_prefix,
    external_link,
    relative_link,
    soft_link_to_external,
    virtual,
    endless_virtual,
]
Way = Callable[[h5py.File, str, tuple[int, ...], Path], None]
ROLES: dict[str, tuple[int, ...]] = {
    "cube": SHAPE,
    "L1/reflectance": SHAPE,
    "wavelengths": (11,),
    "scan/wavelength_nm": (11,),
    "bbl": (11,),
    "anything/else": (4,),
    "scale_factor": (1,),
    "nodata": (1,),
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("matlab", [False, True])
def test_hdf5(tmp_path: Path, secret: Path, way: Way, role: str, matlab: bool) -> None:
    path = tmp_path / "in" / ("x.mat" if matlab else "x.h5")
    path.parent.mkdir()
    with h5py.File(path, "w", userblock_size=512 if matlab else 0) as f:
        way(f, role, ROLES[role], secret)
        if len(ROLES[role]) != 3:
            f["cube"] = VALUES
        if "wave" not in role:
            f["wavelengths"] = NM
        if matlab and "cube" in f and "aside" not in f and ROLES[role] != SHAPE:
            f["cube"].attrs["MATLAB_class"] = np.bytes_("uint8")
    refusal = check_nothing_leaks(path)
    assert isinstance(refusal, CubeFormatError)
    assert "other files" in refusal.message
    np.save(tmp_path / "good.npy", VALUES)
    good = tmp_path / "good.npy"
    for references in ({"white": path}, {"white": good, "dark": path}):
        assert isinstance(check_nothing_leaks(good, **references), CubeFormatError)


def test_hdf5_group_and_units_outside(tmp_path: Path, secret: Path) -> None:
    for name, target in (("scan", "/"), ("wavelength_units", "/text"), ("deep/er/link", "/vector")):
        path = tmp_path / "x.h5"
        with h5py.File(path, "w") as f:
            f["cube"], f["wavelengths"] = VALUES, NM
            f[name] = h5py.ExternalLink(str(secret / "other.h5"), target)
        assert isinstance(check_nothing_leaks(path), CubeFormatError)


def test_hdf5_dimension_scales_and_references_outside(tmp_path: Path, secret: Path) -> None:
    path = tmp_path / "x.nc"
    with h5py.File(path, "w") as f:
        f["data"] = VALUES
        external_storage(f, "wavelength", (11,), secret)
        f["wavelength"].make_scale("wavelength")
        f["data"].dims[2].attach_scale(f["wavelength"])
        f["data"].attrs["wavelengths"] = f["wavelength"].ref
        f["data"].attrs["region"] = f["wavelength"].regionref[:]
    assert isinstance(check_nothing_leaks(path), CubeFormatError)
    # The scale is reached by a reference alone: no name of the file leads to it.
    with h5py.File(path, "r+") as f:
        del f["wavelength"]
    assert check_nothing_leaks(path) is None


def test_hdf5_links_inside_are_fine(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as f:
        f["a/cube"], f["a/wavelengths"] = VALUES, NM
        f["b"] = h5py.SoftLink("/a")
        f["c"] = f["a"]
        f["a/up"] = f["/"]
        f["d"] = h5py.SoftLink("/nowhere")
    cube = open_cube(path)
    np.testing.assert_array_equal(cube.read_rows(0, 7), VALUES)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)


@pytest.mark.parametrize("role", ["cube", "wavelengths"])
def test_hdf5_filter_of_a_plugin(tmp_path: Path, role: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HDF5_PLUGIN_PATH", str(tmp_path))
    path = tmp_path / "x.h5"
    creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    shape = ROLES[role]
    creation.set_chunk(shape)
    creation.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, (2, 2, 1, 10))
    with h5py.File(path, "w") as f:
        h5py.h5d.create(f.id, role.encode(), h5py.h5t.IEEE_F64LE, h5py.h5s.create_simple(shape), dcpl=creation)
        if role != "cube":
            f["cube"] = VALUES
    with pytest.raises(CubeFormatError, match="32001") as caught:
        open_cube(path)
    assert "h5repack" in caught.value.advice
    assert h5py.h5pl.size() == 0

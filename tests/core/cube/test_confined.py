"""No cube file makes its reader hand out another file: each way out of each format, in every role."""

from __future__ import annotations

import os
import struct
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from scipy import io as scipy_io

from specimap_core.cube import Cube, inspect, open_cube
from specimap_core.errors import CubeFormatError, SpecimapError
from specimap_core.screening.cube import judge_cube, judge_part
from tests.support.cube_files import random_values, write_envi

SHAPE = (7, 5, 11)
VALUES = random_values("u1", SHAPE)
NM = np.linspace(400, 1000, 11)
# As reflectance would be, so that no check of values hides it; its bytes occur nowhere else.
SECRET = np.random.default_rng(99).uniform(400, 900, 400)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A folder beside the cube's with a file that no cube may show, as raw numbers, as HDF5 and as TIFF."""
    folder = tmp_path / "secret"
    folder.mkdir()
    (folder / "raw").write_bytes(SECRET.tobytes())
    with h5py.File(folder / "other.h5", "w") as f:
        f["cube"] = np.resize(SECRET, SHAPE)
        f["vector"] = np.resize(SECRET, 11)
        f["text"] = "nm of the secret"
    tifffile.imwrite(folder / "other.tif", np.resize(SECRET, SHAPE), photometric="minisblack")
    return folder


def check_nothing_leaks(path: Path, **references: Path) -> SpecimapError | None:
    """Open, read and judge ``path`` all through; return the refusal. No byte of the secret is in any of it."""
    seen: list[Any] = []
    refusal: SpecimapError | None = None
    try:
        cube = open_cube(path, **references)
        seen += [*_all_of(cube), *inspect(cube, cube.mean_image())]
    except SpecimapError as error:
        refusal = error
        seen += ["".join(traceback.format_exception(error)), error.as_dict()]
    if not references:
        seen += [judge_part(path, path.suffix, None).as_dict(), judge_cube(path).as_dict()]
    words = " ".join(x if isinstance(x, str) else repr(x) for x in seen if not isinstance(x, np.ndarray))
    numbers = [np.asarray(x, np.float64).ravel() for x in seen if isinstance(x, np.ndarray)]
    for value in SECRET:
        assert repr(float(value))[:9] not in words
        assert not any(np.isclose(x, value, rtol=1e-6, atol=0).any() for x in numbers)
    assert "of the secret" not in words
    return refusal


def _all_of(cube: Cube) -> list[Any]:
    return [
        cube.read_rows(0, cube.rows),
        cube.wavelengths_nm,
        cube.bad_bands,
        cube.mean_image(),
        cube.warnings,
        repr(cube),
        cube.quantity,
        cube.fingerprint(),
    ]


# ---- HDF5 -----------------------------------------------------------------------------------------------


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

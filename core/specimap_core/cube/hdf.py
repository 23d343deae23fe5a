"""HDF5 and what is written in it: NetCDF4, MATLAB 7.3.

Whatever is read of a file passes :mod:`specimap_core.cube.hdf_guard`, for a stranger may have sent it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from specimap_core.arrays import Array, Floats
from specimap_core.cube.declared_values import WORDS, Declared, declared_of, is_word, plain
from specimap_core.cube.discover import Variable, choose_cube, choose_wavelengths, cube_axes
from specimap_core.cube.hdf_guard import as_text, guarded_dataset, open_guarded
from specimap_core.cube.model import Cube, describe
from specimap_core.cube.pixels import ArrayPixels, Pixels
from specimap_core.cube.printable import printable
from specimap_core.cube.strided import native
from specimap_core.cube.unpacked import scratch_array
from specimap_core.errors import CubeContentError, CubeTruncatedError

# A larger row of chunks is not kept decoded while it is read by rows: the cube is unpacked once instead.
_LARGEST_CHUNK_ROW = 512 << 20
_TRUNCATED = re.compile(r"truncated file: eof = (\d+).*stored_eof = (\d+)")
_UNIT_ATTRIBUTES = ("units", "unit", "wavelength_units")
_LONGEST_UNITS = 64
_LARGEST_UNITS_BYTES = 1 << 16
# The label of a dimension scale that stands for an axis without coordinates.
_NETCDF_NO_NAME = "This is a netCDF dimension"
_OF_AXES = ("DIMENSION_LABELS", "DIMENSION_LIST")


class HdfFormat:
    """The one numeric dataset with three axes; wavelengths by name; MATLAB's reversed axes put right."""

    name = "HDF5"
    suffixes: tuple[str, ...] = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4", ".mat")
    stored_suffix: str | None = ".h5"

    def matches(self, path: Path) -> bool:
        return bool(h5py.is_hdf5(path))

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        try:
            with open_guarded(path) as file:
                variables = _variables(file)
                cube, about_choice = choose_cube(path, variables, dataset)
                node = guarded_dataset(path, file, cube.name)
                wavelengths, values = _wavelengths(path, file, variables, cube)
                reversed_axes = "MATLAB_class" in node.attrs
                axes, warnings = cube_axes(cube, wavelengths, reversed_axes=reversed_axes)
                declared = _declared(path, file, node)
                pixels = _pixels(path, node, axes)
        except OSError as error:
            sizes = _TRUNCATED.search(str(error))
            if sizes is None:
                raise
            raise CubeTruncatedError(
                f"{path.name} holds {sizes[1]} bytes of {sizes[2]}.",
                advice="Copy the cube again, completely.",
                expected_bytes=int(sizes[2]),
                found_bytes=int(sizes[1]),
            ) from error
        return describe(
            path,
            "MATLAB 7.3" if reversed_axes else self.name,
            pixels,
            wavelengths=values,
            units=wavelengths.units if wavelengths else None,
            declared=declared,
            warnings=about_choice + warnings,
        )


def _variables(file: h5py.File) -> list[Variable]:
    found: list[Variable] = []

    def visit(stored: str | bytes, node: object) -> None:  # visititems follows hard links alone
        if isinstance(node, h5py.Dataset) and node.shape is not None and (dtype := _dtype(node)) is not None:
            name = as_text(stored)
            units = next((_text(value) for key, value in _attributes(node) if key.lower() in _UNIT_ATTRIBUTES), None)
            found.append(Variable(name, tuple(node.shape), dtype, _axis_names(node), units, _content(name, node)))

    file.visititems(visit)
    return found


def _content(name: str, node: h5py.Dataset) -> str | None:
    """The text of a small data set called units: a string, or MATLAB's character codes."""
    small = 0 < node.size <= _LONGEST_UNITS and node.size * node.dtype.itemsize <= _LARGEST_UNITS_BYTES
    if "unit" not in name.rpartition("/")[2].lower() or not small:
        return None
    if _text(node.attrs.get("MATLAB_class")) == "char" and node.dtype.kind == "u":
        return "".join(chr(code) for code in np.asarray(node[()]).ravel(order="F"))
    return _text(np.asarray(node[()])) if h5py.check_string_dtype(node.dtype) else None


def _wavelengths(
    path: Path, file: h5py.File, variables: list[Variable], cube: Variable
) -> tuple[Variable | None, Floats | None]:
    """The wavelengths' variable and its values: a data set, else an attribute of the cube or of a group above it."""
    found = choose_wavelengths(variables, cube)
    if found is not None:
        return found, np.array(guarded_dataset(path, file, found.name)[()], np.float64).ravel()
    node = file[cube.name]
    while True:
        lists = {}
        stated = []
        for name, value in _attributes(node):
            array = np.asarray(value)
            if array.dtype.kind in "iuf" and array.size > 1:
                lists[name] = Variable(name, array.shape, array.dtype), array
            elif (text := _text(value)) is not None:
                stated.append(Variable(name, (), np.dtype(object), text=text))
        found = choose_wavelengths([*(variable for variable, _ in lists.values()), *stated], cube)
        if found is not None and max(found.shape) in cube.shape:
            return found, lists[found.name][1].astype(np.float64).ravel()
        if node.name == "/":
            return None, None
        node = node.parent


def _attributes(node: h5py.Dataset | h5py.Group) -> Iterator[tuple[str, object]]:
    """Names and values of the attributes, without those of a type that NumPy has nothing like."""
    for name in node.attrs:
        try:
            yield as_text(name), node.attrs[name]
        except (TypeError, OSError):
            continue


def _dtype(node: h5py.Dataset) -> np.dtype | None:
    """The type of its values; None for one that NumPy has nothing like (HDF5's times and bit fields)."""
    try:
        dtype: np.dtype = node.dtype
    except TypeError:
        return None
    return dtype


def _axis_names(node: h5py.Dataset) -> tuple[str, ...]:
    """The axes' labels, or the names of the dimension scales that NetCDF4 attaches to them; empty where there are none.

    Read as plain attributes: HDF5's own reader of them takes their type for granted, and crashes where it is another.
    """
    stated = {name: np.asarray(value) for name, value in _attributes(node) if name in _OF_AXES}
    labels, scales = (stated.get(name, np.empty(0)) for name in _OF_AXES)
    names = [""] * node.ndim
    if labels.shape == (node.ndim,):
        names = [_text(label) or "" for label in labels]
    if scales.shape == (node.ndim,) and scales.dtype == object:
        names = [name or _scale_name(node.file, scale) for name, scale in zip(names, scales, strict=True)]
    return tuple(name.rpartition("/")[2] for name in names)


def _scale_name(file: h5py.File, references: object) -> str:
    """The name of the first data set that an axis' entry refers to."""
    reference = next(iter(np.ravel(np.asarray(references, object))), None)
    if not isinstance(reference, h5py.Reference) or not reference:
        return ""
    try:
        scale = file[reference]
    except (ValueError, KeyError, OSError, RuntimeError):  # it refers to nothing
        return ""
    label = next((_text(value) for name, value in _attributes(scale) if name == "NAME"), None) or ""
    return as_text(scale.name or "") if not label or label.startswith(_NETCDF_NO_NAME) else label


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size else None
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else None


def _declared(path: Path, file: h5py.File, dataset: h5py.Dataset) -> Declared:
    """What the cube's own attributes declare of its values, and small data sets next to it (MATLAB keeps them so)."""
    stated: dict[str, object] = {}
    group = dataset.parent
    for name in filter(str.isascii, map(as_text, group)):
        if plain(name) in WORDS and isinstance(group.get(name, getlink=True), h5py.HardLink):
            node = group[name]
            if isinstance(node, h5py.Dataset) and node.shape is not None and is_word(name, node.shape):
                stated[name] = guarded_dataset(path, file, as_text(node.name))[()]
    stated |= {name: value for name, value in _attributes(dataset) if plain(name) in (*WORDS, "unsigned")}
    named = ("long_name", "standard_name", "units", "unit")
    titles = (_text(value) for name, value in _attributes(dataset) if name.lower() in named)
    return declared_of(path.name, stated, as_text(dataset.name), *titles)


def _pixels(path: Path, dataset: h5py.Dataset, axes: tuple[int, int, int]) -> Pixels:
    offset = dataset.id.get_offset()
    if dataset.chunks is None and offset is not None:
        mapped = np.memmap(path, dataset.dtype, "r", offset=offset, shape=dataset.shape)
        return ArrayPixels(np.asarray(mapped).transpose(axes))
    chunk = dataset.chunks or (1, 1, 1)
    rows = chunk[axes[0]]
    row_bytes = rows * dataset.shape[axes[1]] * dataset.shape[axes[2]] * dataset.dtype.itemsize
    if row_bytes <= _LARGEST_CHUNK_ROW:
        return _ChunkedPixels(path, as_text(dataset.name), axes, rows, row_bytes)
    unpacked = scratch_array(dataset.shape, dataset.dtype)
    dataset.read_direct(unpacked)
    return ArrayPixels(unpacked.transpose(axes))


class _ChunkedPixels(Pixels):
    """A dataset in chunks, decoded as its rows are read; one row of chunks stays decoded."""

    def __init__(self, path: Path, name: str, axes: tuple[int, int, int], chunk_rows: int, row_bytes: int) -> None:
        # A cache of its own that holds a row of chunks: each is decoded once, however few rows are asked for.
        self._file = open_guarded(path, rdcc_nbytes=max(1 << 20, row_bytes * 2), rdcc_nslots=100_003)
        self._dataset = guarded_dataset(path, self._file, name)
        self._axes = axes
        self._chunk_rows = chunk_rows
        rows, cols, bands = (int(self._dataset.shape[axis]) for axis in axes)
        self.shape = (rows, cols, bands)
        self.dtype = native(self._dataset.dtype)

    def _read(self, axis: int, part: slice) -> Array:
        selection = [slice(None)] * 3
        selection[self._axes[axis]] = part
        try:
            return np.asarray(self._dataset[tuple(selection)]).transpose(self._axes)
        except OSError as error:
            raise CubeContentError(
                f"'{printable(as_text(self._dataset.name))}' does not decode: {error}.",
                advice="Save the cube again, uncompressed or with gzip.",
            ) from error

    def block(self, start: int, stop: int) -> Array:
        return self._read(0, slice(start, stop))

    def band(self, index: int) -> Array:
        return np.ascontiguousarray(self._read(2, slice(index, index + 1))[:, :, 0], self.dtype)

    def strip_rows(self) -> int:
        whole = max(1, super().strip_rows() // self._chunk_rows)
        return whole * self._chunk_rows

"""ENVI cubes: a text header and a plain binary file next to it."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np

from specimap_core.arrays import Array
from specimap_core.cube.envi_header import EnviHeader, is_envi_header, read_header
from specimap_core.cube.model import Cube, describe
from specimap_core.cube.npy import refuse_dataset
from specimap_core.cube.pixels import ArrayPixels
from specimap_core.cube.unpacked import bytes_of, scratch_array
from specimap_core.errors import CubeHeaderError, CubeNotFoundError, CubeTruncatedError
from specimap_core.notices import Notice, Notices

_HEADER_SUFFIX = ".hdr"
_DATA_SUFFIXES = ("", ".raw", ".img", ".dat", ".bil", ".bip", ".bsq", ".bin", ".hyspex", ".cube", ".hsi", ".envi")
# What instruments and programs put next to a cube under its name; none of it is taken for the data.
_OTHER_SUFFIXES = {
    ".hdr",
    ".txt",
    ".xml",
    ".json",
    ".log",
    ".csv",
    ".tsv",
    ".ini",
    ".md",
    ".pdf",
    ".html",
    ".yaml",
    ".yml",
    ".png",
    ".jpg",
    ".jpeg",
    ".bmp",
    ".gif",
    ".tif",
    ".tiff",
    ".ovr",
    ".enp",
    ".sta",
    ".prj",
    ".lut",
    ".roi",
    ".evf",
    ".npy",
    ".npz",
    ".mat",
    ".h5",
    ".hdf5",
    ".he5",
    ".nc",
    ".zip",
    ".gz",
    ".bak",
    ".tmp",
    ".part",
}
# From the file's axes to (rows, cols, bands).
_FILE_SHAPE = {"bip": (0, 1, 2), "bil": (0, 2, 1), "bsq": (2, 0, 1)}
_TO_CUBE = {"bip": (0, 1, 2), "bil": (0, 2, 1), "bsq": (1, 2, 0)}
_PIECE = 8 << 20


class EnviFormat:
    """``x.hdr`` with ``x``, ``x.raw``, ``.img``, ``.dat``, ``.bil``, ``.hyspex`` and so on; or ``x.bil.hdr``."""

    name = "ENVI"
    suffixes: tuple[str, ...] = (_HEADER_SUFFIX, *_DATA_SUFFIXES)
    stored_suffix: str | None = None

    def matches(self, path: Path) -> bool:
        suffix = path.suffix.lower()
        return suffix == _HEADER_SUFFIX or is_envi_header(path) or _find_header(path) is not None

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        refuse_dataset(path, dataset)
        if path.suffix.lower() == _HEADER_SUFFIX or is_envi_header(path):
            header_path = path
            header = read_header(header_path)
            data_path = _find_data(header_path, header)
        else:
            found = _find_header(path)
            if found is None:
                raise CubeNotFoundError(
                    f"No header lies beside {path.name}.", advice=f"Add {path.name}.hdr.", path=str(path)
                )
            header_path, data_path = found, path
            header = read_header(header_path)
        if header.compressed:
            flat, warnings = _unpacked(data_path, header)
        else:
            flat, warnings = _mapped(data_path, header)
        sizes = (header.rows, header.cols, header.bands)
        array = flat.reshape([sizes[axis] for axis in _FILE_SHAPE[header.interleave]])
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(_TO_CUBE[header.interleave])),
            files=(header_path, data_path),
            wavelengths=header.wavelengths,
            units=header.wavelength_units,
            bad_band_list=header.bad_band_list,
            declared=header.declared,
            warnings=header.warnings + warnings,
        )


def _siblings(path: Path) -> dict[str, list[Path]]:
    """Files of the folder by lower-case name: instruments on Windows mix X.HDR with x.raw."""
    found: dict[str, list[Path]] = {}
    for other in sorted(path.parent.iterdir()):
        found.setdefault(other.name.lower(), []).append(other)
    return found


def _among(siblings: dict[str, list[Path]], name: str) -> Path | None:
    files = [p for p in siblings.get(name.lower(), []) if p.is_file()]
    return next((p for p in files if p.name == name), files[0] if files else None)


def _find_header(data_path: Path) -> Path | None:
    """``x.bil.hdr``, else ``x.hdr``, for the data file ``x.bil``; only one that is an ENVI header."""
    if data_path.suffix.lower() in _OTHER_SUFFIXES:
        return None
    siblings = _siblings(data_path)
    for name in (data_path.name + _HEADER_SUFFIX, data_path.stem + _HEADER_SUFFIX):
        header = _among(siblings, name)
        if header is not None and header != data_path and is_envi_header(header):
            return header
    return None


def _find_data(header_path: Path, header: EnviHeader) -> Path:
    """The data file by ENVI's rules, or of another suffix; of several the first that is long enough."""
    stem = header_path.name[: -len(_HEADER_SUFFIX)] if header_path.suffix else header_path.name
    siblings = _siblings(header_path)
    suffixes = dict.fromkeys(("", "." + header.interleave, *_DATA_SUFFIXES))
    files = [_among(siblings, stem + suffix) for suffix in suffixes]
    candidates = [p for p in files if p is not None and p != header_path]
    needed = 0 if header.compressed else header.data_bytes
    long_enough = next((p for p in candidates if p.stat().st_size >= needed), None)
    if long_enough is not None:
        return long_enough
    # A suffix that nobody has heard of must hold exactly what the header asks for, for it may be anything.
    exact = [p for p in _of_other_suffixes(siblings, stem) if header.compressed or p.stat().st_size == needed]
    if len(exact) == 1:
        return exact[0]
    if not candidates:
        raise CubeNotFoundError(
            f"The data of {header_path.name} are not beside it.",
            advice=f"Put {stem}, {stem}.raw, {stem}.img or {stem}.dat into the header's folder.",
            path=str(header_path),
        )
    return candidates[0]


def _of_other_suffixes(siblings: dict[str, list[Path]], stem: str) -> list[Path]:
    found = [p for name, files in siblings.items() if name.startswith(f"{stem.lower()}.") for p in files]
    return [
        p
        for p in found
        if "." not in p.name[len(stem) + 1 :] and p.suffix.lower() not in _OTHER_SUFFIXES and p.is_file()
    ]


def _truncated(path: Path, expected: int, found: int) -> CubeTruncatedError:
    return CubeTruncatedError(
        f"{path.name} holds {found} bytes, its header asks for {expected}.",
        advice="Copy the cube again, completely; or correct lines, samples, bands, data type in the header.",
        expected_bytes=expected,
        found_bytes=found,
    )


def _excess(excess: int) -> Notices:
    if not excess:
        return ()
    return (Notice("data_longer_than_header", f"The data hold {excess} bytes more than the header says."),)


def _mapped(path: Path, header: EnviHeader) -> tuple[Array, Notices]:
    size, expected = path.stat().st_size, header.data_bytes
    if size < expected:
        raise _truncated(path, expected, size)
    count = (expected - header.offset) // header.dtype.itemsize
    data = np.memmap(path, header.dtype, "r", offset=header.offset, shape=(count,))
    return np.asarray(data), _excess(size - expected)


def _unpacked(path: Path, header: EnviHeader) -> tuple[Array, Notices]:
    """The data of a gzip file; the header's offset counts in what comes out of it."""
    count = (header.data_bytes - header.offset) // header.dtype.itemsize
    # gzip shrinks by 1032 at most: a header that asks for more is refused before room is made for it.
    if path.stat().st_size * 1032 < header.data_bytes:
        raise _truncated(path, header.data_bytes, path.stat().st_size)
    out = scratch_array((count,), header.dtype)
    target = bytes_of(out)
    filled = 0
    try:
        with gzip.open(path) as stream:
            skipped = len(stream.read(header.offset))
            while filled < len(target):
                got = stream.readinto(target[filled : filled + _PIECE])
                if not got:
                    raise _truncated(path, header.data_bytes, skipped + filled)
                filled += got
            excess = len(stream.read(_PIECE))
    except EOFError:
        raise _truncated(path, header.data_bytes, filled) from None
    except (gzip.BadGzipFile, zlib.error) as error:
        raise CubeHeaderError(
            f"{path.name} is not gzip data, though its header says 'file compression = 1': {error}.",
            advice="Correct 'file compression' in the header, or copy the data again.",
            field="file compression",
        ) from error
    return out, _excess(excess)

"""HDF5 files that a stranger may have sent: opened only where nothing in them leads to another file.

HDF5 can keep values in any file of the machine (external storage, virtual data sets) and make other files' contents
its own (external links). A file with any of these, wherever it stands in it and whatever for, is refused whole,
before a value is read. Filters other than HDF5's own would load code from plugins; they are refused too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py

from specimap_core.cube.printable import printable
from specimap_core.errors import CubeFormatError

# Gzip, shuffle, Fletcher32, szip, n-bit, scale-offset and h5py's LZF: they come with the library.
_OWN_FILTERS = {1, 2, 3, 4, 5, 6, 32000}
_MOST_LINKS = 200_000


def open_guarded(path: Path, **options: Any) -> h5py.File:
    """The file, open for reading, after a walk over all its links and data sets.

    Raises CubeFormatError where one leads to another file; OSError where the file is damaged.
    """
    while h5py.h5pl.size():
        h5py.h5pl.remove(0)
    # Without HDF5's lock: an upload that is being finished has one of its own, and some network disks have none.
    file = h5py.File(path, "r", locking=False, **options)
    try:
        _check_links(path, file)
        outside = file.visititems(lambda name, node: as_text(name) if _stored_outside(node) else None)
        if outside is not None:
            raise _leads_out(path, outside)
    except BaseException:
        file.close()
        raise
    return file


def guarded_dataset(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """The data set ``name``, whose values may be read. Raises CubeFormatError where they must not be."""
    # Half characters stand for the bytes of a name that is not UTF-8.
    node = file[name.encode("utf-8", "surrogateescape")]
    if not isinstance(node, h5py.Dataset) or node.file != file or _stored_outside(node):
        raise _leads_out(path, name)
    creation = node.id.get_create_plist()
    filters = [creation.get_filter(i) for i in range(creation.get_nfilters())]
    foreign = [f for f in filters if f[0] not in _OWN_FILTERS]
    if foreign:
        called = foreign[0][3].decode("utf-8", "replace").split(";")[0].strip("\0 ")
        raise CubeFormatError(
            f"{path.name} packs '{printable(name)}' with the HDF5 filter {foreign[0][0]} "
            f"({printable(called) or 'unnamed'}), which is not supported.",
            advice="Save it with gzip or uncompressed, for instance: h5repack -f GZIP=4 IN.h5 OUT.h5",
            filter=foreign[0][0],
        )
    return node


def as_text(name: str | bytes) -> str:
    """A name as text. h5py gives one that is not UTF-8, as some instruments write them, as its bytes."""
    return name.decode("utf-8", "surrogateescape") if isinstance(name, bytes) else name


def _check_links(path: Path, file: h5py.File) -> None:
    count = 0

    # It stops at the first name that is returned; an error raised in it would not come through h5py whole.
    def suspicious(name: bytes) -> str | None:
        nonlocal count
        count += 1
        inside = file.id.links.get_info(name).type in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT)
        return None if inside and count <= _MOST_LINKS else as_text(name)

    # It follows neither soft nor external links. h5py's own way to it stumbles over names that are not UTF-8.
    found = file.id.links.visit(suspicious)
    if count > _MOST_LINKS:
        raise CubeFormatError(
            f"{path.name} holds more than {_MOST_LINKS} objects.", advice="Save the cube in a file of its own."
        )
    if found is not None:
        raise _leads_out(path, found)


def _stored_outside(node: object) -> bool:
    """Its creation properties alone are asked: even the shape of a virtual data set opens the files behind it."""
    if not isinstance(node, h5py.Dataset):
        return False
    creation = node.id.get_create_plist()
    return bool(creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count())


def _leads_out(path: Path, name: str) -> CubeFormatError:
    return CubeFormatError(
        f"{path.name} keeps '{printable(name)}' in other files, which are not read.",
        advice="Save everything in one file (h5repack does), or export the cube as ENVI.",
    )

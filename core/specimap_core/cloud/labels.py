"""Label layers of a cloud: what classifiers and people say about its points, as arrays ``labels/<name>``.

A layer of the kind ``class`` holds one whole number a point (S,), each that of a class. One of the kind
``probability`` holds (S,) or, with a column a class, (S, C) float32 in 0..1; NaN says nothing about a point.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BytesCodec

from specimap_core.arrays import Array
from specimap_core.cloud.schema import SHARD_POINTS
from specimap_core.errors import LabelInvalidError
from specimap_core.json_text import json_text

Kind = Literal["class", "probability"]
CHUNK_LABELS = 4096
LARGEST_CLASS = 65535
GROUP_DOCUMENT = json_text({"zarr_format": 3, "node_type": "group", "attributes": {}}, indent=1).encode()
"""``labels/zarr.json`` next to the layers, so that readers find the group that holds them."""


def checked_labels(
    values: Array, kind: Kind, classes: Sequence[int], points: int
) -> NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]:
    """The values as they are stored: u1 or u2 (S,) for classes, f4 (S,) or (S, C) for probabilities.

    ``classes``: the numbers that stand for a class. Probabilities have a column for each, in their order; with one
    class or none (S,) is enough.

    Raises LabelInvalidError: not one value (or row of C) for each of the ``points``, a number that is no class, a
    probability outside 0..1.
    """
    columns = 0 if kind == "class" else len(classes)
    shapes = [(points,), (points, columns)] if columns == 1 else [(points, columns)] if columns else [(points,)]
    if values.shape not in shapes:
        raise LabelInvalidError(
            f"The values have the shape {list(values.shape)}; the cloud has {points} points.",
            advice=f"Send {' or '.join(str(list(shape)) for shape in shapes)}, in the order of the cloud's points.",
            shape=list(values.shape),
            expected=[list(shape) for shape in shapes],
        )
    if kind == "class":
        return _checked_classes(values, classes)
    if values.dtype.kind not in "fiu":
        raise LabelInvalidError("Probabilities are floating-point numbers.", advice="Send float32.")
    bad = ~((values >= 0) & (values <= 1))
    if values.dtype.kind == "f":
        bad &= ~np.isnan(values)
    _refuse(bad, values, "is no probability", "Give values from 0 to 1; NaN where nothing can be said.")
    return np.ascontiguousarray(values, np.float32)


def _checked_classes(values: Array, classes: Sequence[int]) -> NDArray[np.uint8] | NDArray[np.uint16]:
    if values.dtype.kind not in "iu":
        raise LabelInvalidError(f"Classes are whole numbers, not {values.dtype}.", advice="Send an integer array.")
    # Looked up, since sorting millions of values takes a hundred times longer.
    known = np.zeros(LARGEST_CLASS + 2, bool)
    known[list(classes)] = True
    at = np.where((values < 0) | (values > LARGEST_CLASS), LARGEST_CLASS + 1, values).astype(np.intp)
    advice = "Name every class that occurs, also one for unlabelled points."
    _refuse(~known[at], values, "is none of the classes", advice)
    return values.astype(np.uint8) if max(classes, default=0) <= 255 else values.astype(np.uint16)


def _refuse(bad: NDArray[np.bool_], values: Array, what: str, advice: str) -> None:
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        raise LabelInvalidError(
            f"The value {values[place]} of point {place[0]} {what}; {int(bad.sum())} are not.",
            advice=advice,
            point=place[0],
            count=int(bad.sum()),
        )


def write_label(path: Path, values: Array) -> None:
    """Write checked values as the Zarr v3 array ``path``, laid out as the cloud's own. Not atomic: write aside."""
    rest = values.shape[1:]
    order = None if values.dtype.itemsize == 1 else "little"
    array = zarr.create_array(
        store=str(path),
        shape=values.shape,
        dtype=values.dtype,
        chunks=(CHUNK_LABELS, *rest),
        shards=(SHARD_POINTS, *rest),
        serializer=BytesCodec(endian=order),
        compressors=BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle", typesize=values.dtype.itemsize),
        fill_value=np.nan if values.dtype.kind == "f" else 0,
        dimension_names=("point", "class")[: values.ndim],
        # A missing file then always means damage.
        config={"write_empty_chunks": True},
    )
    array[...] = values


def describe_label(path: Path, attributes: Mapping[str, object]) -> None:
    """Set the attributes of a written layer: ``kind``, ``classes``, ``made_by``, ``version``; JSON values."""
    document = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    document["attributes"] = dict(attributes)
    (path / "zarr.json").write_text(json_text(document, indent=1), encoding="utf-8")

"""Request bodies with labels: metadata in a header, values as an Arrow IPC stream or a npy file."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from specimap_core.arrays import Array
from specimap_core.cloud.labels import LARGEST_CLASS, checked_labels
from specimap_core.errors import LabelInvalidError
from specimap_service.errors import RequestInvalidError

HEADER = "X-Specimap-Label"
MOST_CLASSES = 256
MOST_MADE_BY_BYTES = 8192
EXAMPLE: dict[str, Any] = {
    "kind": "class",
    "classes": [
        {"value": 0, "name": "unlabelled"},
        {"value": 1, "name": "tumour", "colour": "#d62728"},
        {"value": 2, "name": "healthy", "colour": "#2ca02c"},
    ],
    "made_by": {"name": "net-3d", "version": "1.4", "kind": "model"},
}


class LabelClass(BaseModel):
    """A class: its number, name and colour."""

    model_config = ConfigDict(extra="forbid")

    value: int = Field(ge=0, le=LARGEST_CLASS)
    name: str = Field(min_length=1, max_length=100)
    colour: str | None = Field(
        default=None, pattern=r"^#[0-9a-fA-F]{6}$", description="A class with null is not drawn."
    )


class MadeBy(BaseModel):
    """The model or person that made a layer; further fields are kept."""

    model_config = ConfigDict(extra="allow")

    name: str = Field(min_length=1, max_length=200)
    version: str | None = Field(default=None, max_length=200)
    kind: Literal["model", "person"] = "model"


class LabelMetadata(BaseModel):
    """The header's contents, as JSON."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": EXAMPLE})

    kind: Literal["class", "probability"]
    classes: list[LabelClass] = Field(default_factory=list, max_length=MOST_CLASSES)
    made_by: MadeBy

    @model_validator(mode="after")
    def _distinct(self) -> LabelMetadata:
        for field in ("value", "name"):
            given = [getattr(item, field) for item in self.classes]
            if len(set(given)) < len(given):
                raise ValueError(f"two classes have the same {field}")
        if self.kind == "class" and not self.classes:
            raise ValueError("classes names every class that occurs")
        if len(self.made_by.model_dump_json()) > MOST_MADE_BY_BYTES:
            raise ValueError(f"made_by has more than {MOST_MADE_BY_BYTES} bytes")
        return self

    def as_stored(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return self.model_dump(mode="json", exclude_none=True)


def parse_metadata(header: str | None) -> LabelMetadata:
    """Parse the header's JSON.

    Raises:
        RequestInvalidError: the header is missing or invalid; details list the fields.
    """
    if header is None:
        raise RequestInvalidError(f"The header {HEADER} is missing.", advice=f"An example: {EXAMPLE_TEXT}")
    try:
        # HTTP gives bytes as Latin-1; JSON is UTF-8.
        return LabelMetadata.model_validate_json(header.encode("latin-1"))
    except ValidationError as error:
        fields = [
            {"where": ".".join([HEADER, *map(str, item["loc"])]), "what": item["msg"]} for item in error.errors()[:20]
        ]
        raise RequestInvalidError(
            f"{fields[0]['where']}: {fields[0]['what']}.", advice=f"An example: {EXAMPLE_TEXT}", fields=fields
        ) from error


EXAMPLE_TEXT = LabelMetadata.model_validate(EXAMPLE).model_dump_json(exclude_none=True)


def most_bytes(metadata: LabelMetadata, points: int) -> int:
    """Return the bytes that a body of 64-bit values can have; a larger one cannot fit the cloud."""
    columns = 1 if metadata.kind == "class" else max(1, len(metadata.classes))
    return points * columns * 8 + 1024 * 1024


def parse_values(body: Path, arrow: bool, metadata: LabelMetadata, points: int) -> Array:
    """Return the checked values, as they are stored, of a body in a file.

    Raises:
        RequestInvalidError: the body does not decode.
        LabelInvalidError: the values do not fit the cloud or the metadata.
    """
    try:
        values = _from_arrow(body, metadata, points) if arrow else np.lib.format.open_memmap(body, mode="r")
    except LabelInvalidError:
        raise
    except Exception as error:  # on bad input the readers raise nearly anything, StopIteration and TokenError too
        what = "an Arrow IPC stream" if arrow else "a npy file"
        raise RequestInvalidError(
            f"The body is not {what} of numbers: {re.sub(r'/[^ ]*', 'it', str(error))[:200]}.",
            advice="Send an uncompressed Arrow IPC stream, or a npy file without pickled objects.",
        ) from error
    return checked_labels(values, metadata.kind, [item.value for item in metadata.classes], points)


def _from_arrow(body: Path, metadata: LabelMetadata, points: int) -> Array:
    """Read values (S,) of the column ``value`` or ``probability``, or (S, C) of one column for each class."""
    with pa.memory_map(str(body)) as source:
        messages = pa.ipc.MessageReader.open_stream(source)
        schema = pa.ipc.read_schema(messages.read_next_message())
        columns = _columns(schema, metadata)
        blocks: list[Array] = []
        rows = 0
        for message in messages:
            if message.type != "record batch":
                raise ValueError(f"it holds a {message.type}")
            if _compressed(message.metadata.to_pybytes()):
                raise ValueError("it is compressed")
            batch = pa.ipc.read_record_batch(message, schema)
            batch.validate(full=True)
            rows += batch.num_rows
            if rows > points:
                break
            blocks.append(_block(batch, columns, metadata))
    if rows != points:
        raise LabelInvalidError(
            f"The stream has {'more than ' if rows > points else ''}{min(rows, points)} rows.",
            advice=f"The cloud has {points} points: send a row for each, in its order.",
            expected=[[points]],
        )
    values = np.concatenate(blocks)
    return values[:, 0] if columns in (["value"], ["probability"]) else values


def _columns(schema: pa.Schema, metadata: LabelMetadata) -> list[str]:
    for field in schema:
        if not (pa.types.is_integer(field.type) or pa.types.is_floating(field.type)):
            raise ValueError(f"the column {field.name[:50]!r} is of the type {str(field.type)[:50]}")
    names, classes = schema.names, [item.name for item in metadata.classes]
    single = ["value"] if metadata.kind == "class" else ["value", "probability"]
    if len(names) == 1 and names[0] in single:
        return list(names)
    if metadata.kind == "probability" and classes and sorted(names) == sorted(classes):
        return classes
    raise LabelInvalidError(
        f"The stream has the columns {', '.join(map(repr, names))[:200]}.",
        advice="Send one column 'value'; for probabilities of several classes a column for each, named as the class.",
        columns=[name[:100] for name in names[:100]],
    )


def _block(batch: pa.RecordBatch, columns: list[str], metadata: LabelMetadata) -> Array:
    arrays = [batch.column(name) for name in columns]
    if metadata.kind == "class":
        if arrays[0].null_count:
            raise LabelInvalidError(
                "A class is missing (null).", advice="Name a class for unlabelled points, and send its number."
            )
        return np.asarray(arrays[0].to_numpy(zero_copy_only=False))[:, None]
    return np.stack([a.to_numpy(zero_copy_only=False) for a in arrays], 1).astype(np.float32)  # null becomes NaN


def _compressed(metadata: bytes) -> bool:
    """Return whether a record batch's buffers are compressed: their unpacked size has no bound.

    ``metadata`` is a flatbuffer, a field of which pyarrow does not expose.
    """

    def field(table: int, number: int) -> int:
        """Return the position of a table's field; 0 where it has none."""
        vtable = table - struct.unpack_from("<i", metadata, table)[0]
        slot = 4 + 2 * number
        if vtable < 0 or slot >= struct.unpack_from("<H", metadata, vtable)[0]:
            return 0
        offset: int = struct.unpack_from("<H", metadata, vtable + slot)[0]
        return table + offset if offset else 0

    def follow(at: int) -> int:
        return at + int(struct.unpack_from("<I", metadata, at)[0])

    header = field(follow(0), 2)  # Message.header: a RecordBatch
    return field(follow(header), 3) != 0  # RecordBatch.compression

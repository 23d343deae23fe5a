"""The parts of a ``multipart/related`` body (RFC 2387), which lies in a file."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from email.message import Message
from pathlib import Path
from typing import BinaryIO

from specimap_service.errors import MediaTypeError, RequestInvalidError

MOST_PARTS = 500
LONGEST_HEAD = 8192
LONGEST_BOUNDARY = 70
DICOM = "application/dicom"
OFFERED = f"multipart/related; type={DICOM}"
ADVICE = 'Send multipart/related; type="application/dicom" with one object in each part.'


def boundary_of(content_type: str) -> bytes:
    """Return the boundary that a Content-Type names. Raises MediaTypeError for any other kind of body."""
    message = Message()
    message["Content-Type"] = content_type
    boundary, kind = message.get_param("boundary"), message.get_param("type")
    if (
        message.get_content_type() != "multipart/related"
        or (kind is not None and str(kind).lower() != DICOM)
        or not isinstance(boundary, str)
        or not 1 <= len(boundary) <= LONGEST_BOUNDARY
        or not boundary.isascii()
    ):
        raise MediaTypeError("The body is no DICOM objects.", advice=ADVICE, offered=[OFFERED])
    return boundary.encode()


def split_parts(body: Path, boundary: bytes, folder: Path) -> Iterator[Path]:
    """Write each part into the folder, one after the other.

    Raises:
        RequestInvalidError: the body does not read, or has too many parts. What was given before is right.
    """
    delimiter = b"--" + boundary
    if not body.stat().st_size:
        raise _invalid("it is empty")
    with open(body, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
        at = whole.find(delimiter, 0, LONGEST_HEAD)
        if at < 0 or (at > 0 and whole[at - 2 : at] != b"\r\n"):
            raise _invalid("it does not begin with its boundary")
        for number in range(MOST_PARTS + 1):
            at += len(delimiter)
            if whole[at : at + 2] == b"--":
                return
            if number == MOST_PARTS:
                raise _invalid(f"it has more than {MOST_PARTS} parts")
            head = whole.find(b"\r\n\r\n", at, at + LONGEST_HEAD)
            end = whole.find(b"\r\n" + delimiter, max(head, at))
            if whole[at : at + 2] != b"\r\n" or head < 0 or end < head + 2:
                raise _invalid("a part does not read, or does not end")
            if not _is_dicom(whole[at + 2 : head]):
                raise _invalid("a part is no application/dicom")
            part = folder / f"part-{number:04d}.dcm"
            with open(part, "wb") as target:
                file.seek(head + 4)
                _copy(file, target, max(0, end - head - 4))
            yield part
            at = end + 2


def _copy(source: BinaryIO, target: BinaryIO, size: int) -> None:
    left = size
    while left:
        piece = source.read(min(left, 1 << 20))
        target.write(piece)
        left -= len(piece)


def _is_dicom(head: bytes) -> bool:
    lines = head.decode("latin-1").lower().split("\r\n")
    kinds = [line.split(":", 1)[1].split(";")[0].strip() for line in lines if line.startswith("content-type:")]
    return kinds == [DICOM]


def _invalid(what: str) -> RequestInvalidError:
    return RequestInvalidError(f"The body does not read: {what}.", advice=ADVICE)

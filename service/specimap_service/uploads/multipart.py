"""Files of a multipart form, each written to the local disk while it arrives, within limits."""

from __future__ import annotations

import asyncio
import hashlib
import re
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

from fastapi import Request
from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header

from specimap_core.atomic import disk_errors, remove
from specimap_infra.tables import ROLES
from specimap_service.errors import ChecksumMismatchError, PayloadTooLargeError, RequestInvalidError

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

LONGEST_FIELD = 256
LONGEST_HEADER, MOST_HEADERS = 8192, 16
"""Limits of one part."""
MOST_OVERHEAD = 2 * 1024 * 1024
"""Bytes of a form that are not of its files: boundaries, headers, fields, and the beginning of the next part."""
BATCH = 1024 * 1024
_SHA256 = re.compile(r"^[0-9a-fA-F]{64}$")


class Limits(Protocol):
    """Limits that are checked before a file begins, and as it grows."""

    def begin(self, role: str, files: int) -> None:
        """Raise where one more file, the ``files``-th of the request, is too many."""

    def grow(self, role: str, size: int, total: int) -> None:
        """Raise where a file of ``size`` bytes, or ``total`` bytes of all, are too many."""


@dataclass
class Part:
    """A file that has arrived."""

    role: str
    name: str
    path: Path
    size: int = 0
    sha256: str = ""


@dataclass
class _State:
    """State of the parser. ``header_…`` collect one header, ``options`` are those of the part's disposition."""

    header_name: bytearray = field(default_factory=bytearray)
    header_value: bytearray = field(default_factory=bytearray)
    options: dict[bytes, bytes] = field(default_factory=dict)
    headers: int = 0
    pending: list[tuple[str, bytes]] = field(default_factory=list)


class FormFiles:
    """A form with the fields ``role``, ``sha256`` (of the next file) and ``file``; a role holds for the files
    that follow it.
    """

    def __init__(self, folder: Path, limits: Limits) -> None:
        self._folder, self._limits = folder, limits
        self.parts: list[Part] = []
        self._role, self._expected = "", ""
        self._field, self._value = "", bytearray()
        self._file: BinaryIO | None = None
        self._digest = hashlib.sha256()
        self._total = 0
        self._ended = False
        self._state = _State()

    async def read(self, request: Request) -> list[Part]:
        """Read all files of the request's body, at least one.

        Raises:
            RequestInvalidError: the body is not such a form.
            ChecksumMismatchError: a file does not have the checksum that the form gives.
            StorageFullError, PayloadTooLargeError, QuotaExceededError: a file does not fit the disk or the limits.
        """
        kind, options = parse_options_header(request.headers.get("content-type"))
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            raise RequestInvalidError(
                "The body is no multipart form.", advice="Send multipart/form-data with `role` and `file`."
            )
        try:
            parser = MultipartParser(options[b"boundary"], self._callbacks())
            buffer, received = bytearray(), 0
            async for chunk in request.stream():
                buffer += chunk
                if len(buffer) >= BATCH:
                    received += len(buffer)
                    # In a thread, since parsing a form of thousands of tiny parts takes long.
                    await asyncio.to_thread(self._feed, parser, bytes(buffer), received)
                    buffer.clear()
            await asyncio.to_thread(self._feed, parser, bytes(buffer), received + len(buffer))
            parser.finalize()
            await asyncio.to_thread(self._process_events)
        except FormParserError as error:
            raise RequestInvalidError("The form does not read.", advice="Send multipart/form-data.") from error
        if not self._ended or self._file is not None:
            raise RequestInvalidError("The form is cut short.", advice="Send it again.")
        if not self.parts:
            raise RequestInvalidError("The form holds no file.", advice="Add the field `file`, after `role`.")
        return self.parts

    def close(self) -> None:
        """Remove the files that were not taken."""
        if self._file is not None:
            self._file.close()
        for part in self.parts:
            remove(part.path)

    # ---- the parser's events, collected, then processed in a thread ------------------------------------

    def _callbacks(self) -> MultipartCallbacks:
        state = self._state

        def begin() -> None:
            state.options, state.headers = {}, 0

        def header_field(data: bytes, start: int, end: int) -> None:
            state.header_name += data[start:end]
            check_header()

        def header_value(data: bytes, start: int, end: int) -> None:
            state.header_value += data[start:end]
            check_header()

        def check_header() -> None:
            if len(state.header_name) + len(state.header_value) > LONGEST_HEADER:
                raise RequestInvalidError("A header of the form is too long.", advice="Send multipart/form-data.")

        def header_end() -> None:
            if bytes(state.header_name).lower() == b"content-disposition":
                _, state.options = parse_options_header(bytes(state.header_value))
            state.header_name.clear()
            state.header_value.clear()
            state.headers += 1
            if state.headers > MOST_HEADERS:
                raise RequestInvalidError("A part has too many headers.", advice="Send multipart/form-data.")

        def headers_finished() -> None:
            name = state.options.get(b"name", b"").decode("utf-8", "replace")
            if name == "file":
                state.pending.append(("file", state.options.get(b"filename", b"")))
            else:
                state.pending.append(("field", name.encode()))

        def data(piece: bytes, start: int, end: int) -> None:
            state.pending.append(("data", piece[start:end]))

        return {
            "on_part_begin": begin,
            "on_header_field": header_field,
            "on_header_value": header_value,
            "on_header_end": header_end,
            "on_headers_finished": headers_finished,
            "on_part_data": data,
            "on_part_end": lambda: state.pending.append(("part end", b"")),
            "on_end": lambda: state.pending.append(("end", b"")),
        }

    def _feed(self, parser: MultipartParser, data: bytes, received: int) -> None:
        parser.write(data)
        self._process_events()
        if received - self._total > MOST_OVERHEAD:
            raise PayloadTooLargeError(
                "The form holds too much beside its files.", advice="Send `role` and `file`.", limit_bytes=MOST_OVERHEAD
            )

    def _process_events(self) -> None:
        pending, self._state.pending = self._state.pending, []
        with disk_errors(self._folder):
            for what, data in pending:
                if what == "file":
                    self._begin_file(data.decode("utf-8", "replace"))
                elif what == "field":
                    self._field = data.decode()
                elif what == "data":
                    self._take(data)
                elif what == "part end":
                    self._end_part()
                elif what == "end":
                    self._ended = True

    def _begin_file(self, name: str) -> None:
        if not self._role:
            raise RequestInvalidError("A file stands before its role.", advice="Put the field `role` before `file`.")
        self._limits.begin(self._role, len(self.parts) + 1)
        part = Part(self._role, name, self._folder / f"{uuid.uuid4().hex}.part")
        self.parts.append(part)
        self._file = open(part.path, "xb")  # noqa: SIM115 - closed at the part's end
        self._digest = hashlib.sha256()

    def _take(self, data: bytes) -> None:
        if self._file is None:
            self._value += data
            if len(self._value) > LONGEST_FIELD:
                raise RequestInvalidError(
                    f"The field {self._field[:40]!r} is too long.", advice="Send `role` and `file`."
                )
            return
        part = self.parts[-1]
        part.size += len(data)
        self._total += len(data)
        self._limits.grow(part.role, part.size, self._total)
        self._file.write(data)
        self._digest.update(data)

    def _end_part(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
            part = self.parts[-1]
            part.sha256 = self._digest.hexdigest()
            if self._expected and part.sha256 != self._expected:
                raise ChecksumMismatchError(
                    "A file's SHA-256 is another one than the form says.", advice="Send it again.", sha256=part.sha256
                )
            self._expected = ""
            return
        value = self._value.decode("utf-8", "replace").strip()
        self._value.clear()
        if self._field == "role" and value in ROLES:
            self._role = value
        elif self._field == "sha256" and _SHA256.match(value):
            self._expected = value.lower()
        else:
            raise RequestInvalidError(
                f"The form's field {self._field[:40]!r} is not known, or its value cannot be.",
                advice=f"Send `role` (one of {', '.join(ROLES)}), `file`, and `sha256` of the next file if you like.",
                field=self._field[:40],
            )

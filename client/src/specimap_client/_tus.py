"""One resumable upload (tus 1.0: creation, checksum), which goes on after any broken connection."""

from __future__ import annotations

import base64
import hashlib
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import httpx

from specimap_client import _retries
from specimap_client._errors import (
    ApiError,
    ConnectionFailed,
    NotFound,
    RateLimited,
    ServerError,
    Timeout,
    UnexpectedAnswer,
    UploadFailed,
)
from specimap_client._http import Session, path
from specimap_client._models import Failure, File

CHUNK = 8 << 20
"""Bytes of a request: what is held in memory, and the most that a broken connection costs."""
_TUS = {"Tus-Resumable": "1.0.0"}
_OUT_OF_STEP = frozenset({409, 423, 460})
"""Another offset than the service's, another request still writing, bytes that changed on the way."""
_GONE = frozenset({404, 410})
_JUDGED_AFTER = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)


class GoneError(Exception):
    """The service has no such open upload: finished, expired or terminated."""


class _OutOfStepError(Exception):
    """The service's idea of the upload is another; its offset tells."""


class Tus:
    """Uploads of files to one acquisition."""

    def __init__(self, session: Session, acquisition: str) -> None:
        self._session = session
        self._acquisition = acquisition

    def create(self, file: Path, role: str, size: int) -> str:
        """The id of a new upload. A lost answer leaves an upload without bytes behind, which expires."""
        metadata = {"acquisition": self._acquisition, "role": role, "filename": file.name}
        pairs = ",".join(f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in metadata.items())
        headers = {"Upload-Length": str(size), "Upload-Metadata": pairs, "Idempotency-Key": str(uuid.uuid4())}
        answer = self._session.request("POST", path("uploads"), headers=_TUS | headers)
        # The id alone: a proxy may have written another host into the address, which must not see the key.
        upload: str = answer.headers.get("Location", "").rstrip("/").rpartition("/")[2]
        if not upload:
            raise UnexpectedAnswer("The upload was created without an address.")
        return upload

    def send(self, upload: str, file: Path, size: int, progress: Callable[[int], None]) -> str | None:
        """Send what the service does not have yet; the SHA-256 of the file, None where not all of it was read here.

        Raises:
            GoneError: there is no such open upload; :meth:`result` tells what became of it.
            UploadFailed: no byte more arrived in as many attempts as ``Retries`` says, or the file changed.
            ApiError: the service refuses it.
        """
        digest = _Digest()
        offset: int | None = None
        furthest = -1
        failures = 0
        with file.open("rb") as stream:
            while offset is None or offset < size:
                wait: float | None = None
                try:
                    if offset is None:
                        offset = self._offset(upload)
                    else:
                        chunk = _read(stream, offset, min(CHUNK, size - offset), file)
                        digest.offer(offset, chunk)
                        offset = self._patch(upload, offset, chunk)
                except (ConnectionFailed, Timeout, ServerError, RateLimited, _OutOfStepError) as error:
                    failures += 1
                    if failures >= self._session.retries.attempts:
                        raise UploadFailed(
                            f"{file.name}: no byte more arrived in {failures} attempts. {error}",
                            path=str(file),
                            upload_id=upload,
                            advice="Upload again: it goes on where it stopped.",
                        ) from error
                    wait = error.retry_after if isinstance(error, RateLimited) else None
                    offset = None
                    _retries.sleep(self._session.retries.delay(failures - 1, wait))
                    continue
                if offset > furthest:
                    furthest, failures = offset, 0
                    digest.keep(offset)
                    progress(offset)
        return digest.of_all(size)

    def result(self, upload: str, patience_s: float, file: Path) -> File | None:
        """The judged file; None where the upload waits for more bytes.

        Raises:
            UploadFailed: the upload failed, has expired or was terminated.
            Timeout: the service is not done with it in ``patience_s``.
        """
        waited, attempt = 0.0, 0
        while True:
            try:
                answer = self._session.json("GET", path("uploads", upload, "result"))
            except NotFound as error:
                raise UploadFailed(f"{file.name}: the upload is gone.", path=str(file), code=error.code) from error
            state = answer.get("state") if isinstance(answer, dict) else None
            if state == "finished":
                if answer.get("file") is None:
                    raise UploadFailed(f"{file.name} was deleted again.", path=str(file), code="file_deleted")
                return File.of(answer["file"])
            if state == "open" and answer.get("offset") != answer.get("size"):
                return None
            if state != "open":
                told = answer.get("error") if isinstance(answer, dict) else None
                failure = Failure.of(told) if told else Failure(code=f"upload_{state}", message="It did not arrive.")
                raise UploadFailed(
                    f"{file.name}: {failure.message}", path=str(file), code=failure.code, advice=failure.advice
                )
            if waited >= patience_s:
                raise Timeout(f"{file.name} has arrived, but was not judged within {patience_s:g} s.")
            pause = _JUDGED_AFTER[min(attempt, len(_JUDGED_AFTER) - 1)]
            _retries.sleep(pause)
            waited, attempt = waited + pause, attempt + 1

    def _offset(self, upload: str) -> int:
        """How many bytes the service has; one attempt, since :meth:`send` counts them."""
        answer = self._in_step("HEAD", upload)
        return _number(answer.headers.get("Upload-Offset"))

    def _patch(self, upload: str, offset: int, chunk: bytes) -> int:
        checksum = base64.b64encode(hashlib.sha256(chunk).digest()).decode()
        answer = self._in_step(
            "PATCH",
            upload,
            headers={
                "Upload-Offset": str(offset),
                "Upload-Checksum": f"sha256 {checksum}",
                "Content-Type": "application/offset+octet-stream",
            },
            content=chunk,
        )
        return _number(answer.headers.get("Upload-Offset"))

    def _in_step(self, method: str, upload: str, **options: Any) -> httpx.Response:
        headers = _TUS | options.pop("headers", {})
        try:
            return self._session.request(method, path("uploads", upload), headers=headers, once=True, **options)
        except ApiError as error:
            if error.status in _GONE:
                raise GoneError from error
            if error.status in _OUT_OF_STEP:
                raise _OutOfStepError(str(error)) from error
            raise


class _Digest:
    """SHA-256 of the bytes that the service took, as long as they come in order."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._at = 0
        self._chunk = (0, b"")

    def offer(self, offset: int, chunk: bytes) -> None:
        """The next bytes to be sent."""
        self._chunk = (offset, chunk)

    def keep(self, offset: int) -> None:
        """The service has the bytes before ``offset``."""
        start, chunk = self._chunk
        if start <= self._at <= offset <= start + len(chunk):
            self._hash.update(memoryview(chunk)[self._at - start : offset - start])
            self._at = offset

    def of_all(self, size: int) -> str | None:
        """Of the whole file; None where a part was sent before."""
        return self._hash.hexdigest() if self._at == size else None


def _read(stream: BinaryIO, offset: int, size: int, file: Path) -> bytes:
    stream.seek(offset)
    chunk = stream.read(size)
    if len(chunk) != size:
        raise UploadFailed(f"{file.name} became shorter while it was sent.", path=str(file), code="file_changed")
    return chunk


def _number(header: str | None) -> int:
    try:
        return int(header or "")
    except ValueError as error:
        raise UnexpectedAnswer("The service did not say how many bytes it has.") from error

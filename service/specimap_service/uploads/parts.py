"""Bytes of unfinished uploads in the storage, so that API processes of several machines serve the same upload.

What arrives is stored in parts, and a row for each tells where it lies; together they are what has arrived. A request
may come to any machine: each reads the offset from the database, whose lock it takes to write. A process that is
killed loses what it had not stored yet, at most one part, and the client goes on from the offset.
"""

from __future__ import annotations

import datetime
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import NotFoundError, SpecimapError
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.logs import logger
from specimap_infra.storage import Storage
from specimap_infra.strays import UPLOADS
from specimap_infra.tables import Upload, UploadPart
from specimap_service.uploads.files import Appender, UploadFiles, busy, check_id
from specimap_service.uploads.locks import Held, UploadLocks

PREFIX = UPLOADS
"""Folder in the storage."""
PART = 8 * 1024 * 1024
SMALL = 1024 * 1024
"""A part that is smaller is stored again together with what follows it: an upload in tiny pieces has few parts."""


@dataclass(frozen=True)
class _Part:
    start: int
    size: int
    key: str


class UploadParts:
    """Parts of unfinished uploads. ``folder`` is for what is put together, on a local disk."""

    def __init__(self, database: Database, storage: Storage, folder: Path) -> None:
        self._database, self._storage = database, storage
        self._locks = UploadLocks(database)
        self._local = UploadFiles(folder)
        self.folder = folder

    def create(self, upload_id: str) -> None:
        """Do nothing: the row is the place."""

    def size(self, upload_id: str) -> int | None:
        """Return the bytes that are stored; None where there is no such unfinished upload."""
        with self._database.session() as session:
            return session.scalar(sa.select(Upload.received).where(Upload.id == upload_id, Upload.state == "open"))

    def coming(self, session: Session) -> int:
        """Count the bytes of open uploads, each of which is put together on the local disk when it has arrived."""
        total = sa.select(sa.func.sum(Upload.size)).where(Upload.state == "open", Upload.expires_at > utc_now())
        return int(session.scalar(total) or 0)

    def remove(self, upload_id: str) -> None:
        """Remove the parts. Where the storage is away, the next sweep does."""
        check_id(upload_id)
        with self._database.session() as session:
            session.execute(sa.delete(UploadPart).where(UploadPart.upload_id == upload_id))
        self._delete(f"{PREFIX}/{upload_id}")

    def _delete(self, key: str) -> None:
        try:
            self._storage.delete(key)
        except StorageUnavailableError as error:
            logger().warning("parts of an upload not removed yet", key=key, code=error.code)

    def try_lock(self, upload_id: str) -> Appender | None:
        """Take the upload's lock; None where another request holds it. Raises NotFoundError."""
        check_id(upload_id)
        held = self._locks.take(upload_id)
        return None if held is None else _Appender(self, self._locks, held)

    @contextmanager
    def whole(self, upload_id: str) -> Iterator[Path]:
        """Put the parts together on the local disk.

        Raises:
            StorageUnavailableError, StorageFullError: they cannot be read, or do not fit.
        """
        with self._database.session() as session:
            rows = sa.select(UploadPart).where(UploadPart.upload_id == upload_id).order_by(UploadPart.start)
            parts = _read(session, rows)
        path = self.folder / f"{upload_id}.whole"
        try:
            with disk_errors(path), open(path, "wb") as file:
                for part in parts:
                    if file.tell() != part.start:
                        raise _damaged(upload_id)
                    with _there(upload_id):
                        for piece in self._storage.stream(part.key):
                            file.write(piece)
                    if file.tell() != part.start + part.size:
                        raise _damaged(upload_id)
            yield path
        finally:
            remove(path)

    def sweep(self, known: set[str], seconds: float) -> None:
        """Remove what is older and belongs to no upload of ``known``, or was never counted as arrived."""
        self._local.sweep(known, seconds)
        before = utc_now() - datetime.timedelta(seconds=seconds)
        # The files before the rows: a part is stored before its row is written.
        old = [item.key for item in self._storage.list(PREFIX) if item.modified < before]
        with self._database.session() as session:
            of_rows = sa.select(UploadPart.storage_key).where(UploadPart.upload_id.in_(known))
            counted = set(session.scalars(of_rows)) if old else set()
        for key in old:
            if key not in counted:
                self._delete(key)

    # ---- writing --------------------------------------------------------------------------------------

    def store(self, held: Held, received: int, data: bytes) -> None:
        """Store what follows the first ``received`` bytes, and count it as arrived.

        Raises:
            UploadLockedError: another request has the lock now; nothing has been counted.
            StorageUnavailableError, StorageFullError, DatabaseUnavailableError.
        """
        with self._database.session() as session:
            rows = sa.select(UploadPart).where(UploadPart.upload_id == held.upload_id, UploadPart.size < SMALL)
            ends = rows.where(UploadPart.start + UploadPart.size == received)
            grown = next(iter(_read(session, ends)), None)
        if grown is not None:
            with _there(held.upload_id):
                data = self._storage.read(grown.key) + data
        start = received if grown is None else grown.start
        part = _Part(start, len(data), f"{PREFIX}/{held.upload_id}/{start:013d}-{uuid.uuid4().hex[:12]}")
        self._put(part.key, data)
        if not self._count(held, received, part):
            self._delete(part.key)
            raise busy()
        if grown is not None:
            self._delete(grown.key)

    def _put(self, key: str, data: bytes) -> None:
        if self._storage.folder is None:
            self._storage.put(key, data)
            return
        # By a file, which is flushed to the disk before it has its name.
        aside = self.folder / f"{key.split('/')[1]}.{uuid.uuid4().hex[:12]}"
        try:
            with disk_errors(aside):
                aside.write_bytes(data)
            self._storage.put_file(key, aside)
        finally:
            remove(aside)

    def _count(self, held: Held, received: int, part: _Part) -> bool:
        """Count a part as arrived, if the lock is still this holder's."""
        with self._database.session() as session:
            own = sa.and_(
                Upload.id == held.upload_id,
                Upload.holder == held.holder,
                Upload.state == "open",
                Upload.received == received,
            )
            counted = session.execute(
                sa.update(Upload).where(own).values(received=part.start + part.size).returning(Upload.id),
                execution_options={"synchronize_session": False},
            )
            if counted.first() is None:
                return False
            session.merge(UploadPart(upload_id=held.upload_id, start=part.start, size=part.size, storage_key=part.key))
            return True


def _read(session: Session, rows: sa.Select[UploadPart]) -> list[_Part]:
    return [_Part(row.start, row.size, row.storage_key) for row in session.scalars(rows)]


class _Appender:
    """A locked upload; its bytes are gathered to parts."""

    def __init__(self, parts: UploadParts, locks: UploadLocks, held: Held) -> None:
        self._parts, self._locks, self._held = parts, locks, held
        self._received = held.received
        self._gathered = bytearray()
        self._failed: SpecimapError | None = None

    def write(self, piece: memoryview) -> int:
        """Gather bytes; store them once they are a part."""
        if self._failed is not None:
            raise self._failed
        self._gathered += piece
        if len(self._gathered) >= PART:
            self._store()
        return len(piece)

    def sync(self) -> None:
        """Store what was gathered."""
        if self._gathered:
            self._store()

    def _store(self) -> None:
        data, self._gathered = bytes(self._gathered), bytearray()
        # Whatever goes wrong, what follows would leave a gap.
        self._failed = busy()
        try:
            self._parts.store(self._held, self._received, data)
        except SpecimapError as error:
            self._failed = error
            raise
        self._failed = None
        self._received += len(data)

    def close(self) -> None:
        """Give the lock back."""
        self._locks.release(self._held)

    def when_wanted(self, call: Callable[[], None]) -> None:
        """Let ``call`` be called while another request waits for the lock."""
        self._locks.when_wanted(self._held, call)


@contextmanager
def _there(upload_id: str) -> Iterator[None]:
    try:
        yield
    except NotFoundError as error:
        raise _damaged(upload_id) from error


def _damaged(upload_id: str) -> StorageUnavailableError:
    return StorageUnavailableError(
        f"Parts of {upload_id} are not in the storage.", advice="End the upload with DELETE, and start it again."
    )

"""Storage of files that several processes share: a folder, or a bucket of an S3-compatible store.

Keys are paths of safe names made by the program (``jobs/job_…/register/att_…/cloud.zarr/zarr.json``); names that a
person gave never become part of one. Files appear whole; a folder's files are referred to only once all are stored.
"""

from __future__ import annotations

import datetime
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import obstore
from obstore.store import LocalStore, S3Store

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import SettingsError, StorageFullError
from specimap_infra.availability import Availability
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage_errors import checked, is_away, not_found, store_errors

CHUNK = 1024 * 1024
TEMPORARY = "tmp"
"""Folder in a local storage for files being written; those that killed writers left may be removed after a day."""


@dataclass(frozen=True)
class Stored:
    """A stored file."""

    key: str
    size: int
    etag: str
    modified: datetime.datetime


class Storage:
    """Files by key. Safe to share between threads.

    All methods raise StorageUnavailableError where the store does not answer; writing ones raise StorageFullError.
    """

    def __init__(self, store: LocalStore | S3Store, folder: Path | None, scratch: Path) -> None:
        self.store = store
        self.folder = folder
        """The folder, where the storage is one."""
        self._scratch = scratch
        self._availability = Availability("storage", _refused, refuses=folder is None)

    @classmethod
    def open(cls, settings: ServiceSettings) -> Self:
        """Open the storage that the settings name.

        Raises:
            SettingsError: it cannot be made.
        """
        place = settings.storage_place
        with disk_errors(settings.scratch):
            # One after the other, since missing parent folders are made with the usual rights.
            for private in (settings.data_dir, settings.scratch):
                private.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not place.startswith("s3://"):
            folder = Path(place).absolute()
            with disk_errors(folder):
                for private in (folder, folder / TEMPORARY):
                    private.mkdir(parents=True, exist_ok=True, mode=0o700)
            return cls(LocalStore(folder), folder, settings.scratch)
        bucket, _, prefix = place.removeprefix("s3://").partition("/")
        try:
            store = S3Store(
                bucket,
                prefix=prefix or None,
                endpoint=settings.s3_endpoint or None,
                region=settings.s3_region,
                virtual_hosted_style_request=False,
                client_options={
                    "allow_http": settings.s3_endpoint.startswith("http://"),
                    "timeout": "60s",
                    "connect_timeout": "5s",
                    # Also the longest time that one request's bytes, and the answer to them, may take.
                    "read_timeout": "12s",
                },
                # Short: whoever can wait longer tries again as a whole.
                retry_config={"max_retries": 3, "retry_timeout": datetime.timedelta(seconds=5)},
            )
        except (ValueError, obstore.exceptions.BaseError) as error:
            raise SettingsError(
                f"The storage {place} cannot be opened: {error}.", advice="Correct SPECIMAP_STORAGE.", setting="storage"
            ) from error
        return cls(store, None, settings.scratch)

    # ---- reading --------------------------------------------------------------------------------------

    def path(self, key: str) -> Path | None:
        """Return the file or folder itself, where the storage is a folder; it need not exist."""
        return None if self.folder is None else self.folder / checked(key)

    def stat(self, key: str) -> Stored:
        """Return size and ETag. Raises NotFoundError."""
        with self._trying(key):
            return _stored(obstore.head(self.store, checked(key)))

    def read(self, key: str, start: int = 0, stop: int | None = None) -> bytes:
        """Read the file's bytes from ``start`` up to ``stop``. Raises NotFoundError."""
        whole = start == 0 and stop is None
        end = self.stat(key).size if stop is None and not whole else stop or 0
        with self._trying(key):
            if whole:
                return bytes(obstore.get(self.store, checked(key)).bytes())
            return bytes(obstore.get_range(self.store, checked(key), start=start, end=end)) if end > start else b""

    def stream(self, key: str, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
        """Read as :meth:`read` does, piece by piece. Raises NotFoundError before the first piece."""
        local = self.path(key)
        if local is not None:
            with store_errors(key), open(local, "rb") as file:
                file.seek(start)
                left = (stop if stop is not None else os.fstat(file.fileno()).st_size) - start
                while left > 0 and (piece := file.read(min(CHUNK, left))):
                    left -= len(piece)
                    yield piece
            return
        at, end = start, self.stat(key).size if stop is None else stop
        while at < end:
            piece = self.read(key, at, min(at + 8 * CHUNK, end))
            at += len(piece)
            yield piece

    def list(self, prefix: str) -> Iterator[Stored]:
        """List all files below a prefix."""
        with self._trying(prefix):
            for batch in obstore.list(self.store, checked(prefix) + "/"):
                yield from map(_stored, batch)

    def fetch(self, key: str, target: Path) -> None:
        """Link a file, or all files below a prefix, to ``target``; copy them where links are impossible."""
        local = self.path(key)
        with disk_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            if local is not None:
                if not local.exists():
                    raise not_found(key)
                # A link is instant, and keeps the data for a running stage if the file is deleted meanwhile.
                link(local, target)
                return
            found = list(self.list(key))
            for item in found:
                self._download(item.key, target / item.key.removeprefix(f"{key}/"))
            if not found:
                self._download(key, target)

    def _download(self, key: str, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        aside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
        try:
            with open(aside, "wb") as file:
                for piece in self.stream(key):
                    file.write(piece)
            aside.replace(target)
        finally:
            remove(aside)

    # ---- writing --------------------------------------------------------------------------------------

    def put(self, key: str, data: bytes) -> None:
        """Write a file whole or not at all."""
        with self._trying(key):
            obstore.put(self.store, checked(key), data)

    def put_file(self, key: str, source: Path) -> None:
        """Move a local file into the storage, whole or not at all; ``source`` is gone afterwards."""
        local = self.path(key)
        with self._trying(key):
            if local is None:
                obstore.put(self.store, checked(key), source, chunk_size=8 * CHUNK)
                source.unlink()
                return
            with disk_errors(local):
                local.parent.mkdir(parents=True, exist_ok=True)
                _flush(source)
                try:
                    os.replace(source, local)
                except OSError:  # on another disk
                    aside = self._aside(local.name)
                    try:
                        shutil.copyfile(source, aside)
                        _flush(aside)
                        os.replace(aside, local)
                    finally:
                        remove(aside)
                    source.unlink()
                _flush(local.parent)

    @contextmanager
    def publishing(self, prefix: str) -> Iterator[Path]:
        """Make a local folder to fill; its files are stored below ``prefix`` when the block succeeds.

        In a folder they appear together, by one rename. In a bucket they appear one by one: nothing may refer to
        the prefix before the block has ended. Where it fails it may be done again, under the same prefix.
        """
        local = self.path(prefix)
        aside = self._aside(prefix.rsplit("/", 1)[-1]) if local else self._scratch / f"{uuid.uuid4().hex}.tmp"
        with disk_errors(aside):
            aside.mkdir(parents=True)
        try:
            yield aside
            if local is None:
                for file in sorted(p for p in aside.rglob("*") if p.is_file()):
                    self.put_file(f"{prefix}/{file.relative_to(aside).as_posix()}", file)
                return
            with self._trying(prefix):
                local.parent.mkdir(parents=True, exist_ok=True)
                # Of a try whose end was not heard of.
                remove(local)
                os.rename(aside, local)
                _flush(local.parent)
        finally:
            remove(aside)

    def delete(self, key: str) -> None:
        """Remove a file, or all files below a prefix; not an error where there is none."""
        local = self.path(key)
        keys = [item.key for item in self.list(key)] if local is None else []
        with self._trying(key):
            if local is not None:
                if local.is_dir():
                    # Hidden at once by a rename, then removed file by file.
                    aside = self._aside(local.name)
                    os.rename(local, aside)
                    remove(aside)
                else:
                    local.unlink(missing_ok=True)
                return
            for at in range(0, len(keys), 1000):
                obstore.delete(self.store, keys[at : at + 1000])
            obstore.delete(self.store, checked(key))

    def _aside(self, name: str) -> Path:
        assert self.folder is not None
        return self.folder / TEMPORARY / f"{name}.{uuid.uuid4().hex[:8]}.tmp"

    @contextmanager
    def _trying(self, key: str) -> Iterator[None]:
        """One try at the store, which never holds another one."""
        with self._availability.trying(is_away), store_errors(key):
            yield

    # ---- state ----------------------------------------------------------------------------------------

    def free_bytes(self) -> int | None:
        """Return the free bytes of the folder's disk; None for a bucket."""
        if self.folder is None:
            return None
        with store_errors(str(self.folder)):
            return shutil.disk_usage(self.folder).free

    def check_at_start(self) -> None:
        """Check as :meth:`check` does, but only warn of a full storage: a running service lets users free space."""
        try:
            self.check()
        except StorageFullError:
            logger().warning("the storage is full: new uploads are refused, and jobs may fail")

    def check(self) -> None:
        """Raise StorageUnavailableError or StorageFullError where nothing can be written."""
        key = f"{TEMPORARY}/check-{uuid.uuid4().hex}"
        self.put(key, b"1")
        self.delete(key)


def _stored(meta: obstore.ObjectMeta) -> Stored:
    etag = (meta["e_tag"] or f"{meta['size']:x}-{meta['last_modified'].timestamp():x}").strip('"')
    return Stored(meta["path"], meta["size"], etag, meta["last_modified"])


def link(source: Path, target: Path) -> None:
    """Link a file, or the files of a folder; copy them where links are impossible."""
    if source.is_dir():
        shutil.copytree(source, target, copy_function=_link)
    else:
        _link(source, target)


def _refused() -> StorageUnavailableError:
    return StorageUnavailableError("The storage does not answer.", advice="Try again later.")


def _link(source: str | Path, target: str | Path) -> object:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return target


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

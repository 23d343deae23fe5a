"""Band-major copies of large clouds in the scratch folder: a band is then read as one piece.

Spectra are stored point by point, so that one band of all points takes the decoding of all spectra, seconds for a
full-size cloud. The first request for a band of a cloud has a copy made in the background; later ones read from it.
A copy may be lost at any time.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from anyio import BrokenWorkerProcess, CapacityLimiter, to_process
from fastapi.concurrency import run_in_threadpool
from numpy.typing import NDArray

from specimap_core.atomic import remove
from specimap_core.errors import SpecimapError
from specimap_infra.database import Database
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import CloudRow
from specimap_service.clouds.band_copying import copy_bands
from specimap_service.clouds.open_clouds import CloudRecord

FOLDER = "bands"
LEAST_BYTES = 64 * 1024**2
"""Spectra of a cloud below which a band is read quickly anyway."""
SWEEP_SECONDS = 30.0
MOST_WAITING = 16


class BandCopies:
    """The copies on this machine, shared by its API processes. Safe to share between threads."""

    def __init__(self, settings: ServiceSettings, database: Database) -> None:
        self._settings = settings
        self._database = database
        self._folder = settings.scratch / FOLDER
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wanted: dict[str, CloudRecord] = {}
        self._failed: set[str] = set()
        self._ask = asyncio.Event()
        self._process = CapacityLimiter(1)

    def band(self, record: CloudRecord, band: int) -> NDArray[np.uint16] | None:
        """Return the stored values (S,) of a band, or None where there is no copy yet; it is made then, if it fits."""
        path = self._path(record.id)
        try:
            with path.open("rb") as file:
                if os.fstat(file.fileno()).st_size == self._size(record):
                    file.seek(2 * record.points * band)
                    values = np.fromfile(file, np.uint16, record.points)
                    if len(values) == record.points:
                        os.utime(path)
                        return values
        except OSError:
            pass
        self._want(record)
        return None

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Make copies that are wanted, and remove those of no further use, within the block."""
        self._loop = asyncio.get_running_loop()
        tasks = [asyncio.create_task(self._make()), asyncio.create_task(self._sweep())]
        try:
            yield
        finally:
            self._loop = None
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    # ---- inside ---------------------------------------------------------------------------------------

    def _path(self, cloud_id: str) -> Path:
        return self._folder / f"{cloud_id}.u2"

    @staticmethod
    def _size(record: CloudRecord) -> int:
        return 2 * record.points * record.bands

    def _want(self, record: CloudRecord) -> None:
        size, loop = self._size(record), self._loop
        if not LEAST_BYTES <= size <= self._settings.band_copies_bytes or record.id in self._failed or loop is None:
            return
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(self._note, record)

    def _note(self, record: CloudRecord) -> None:
        if len(self._wanted) < MOST_WAITING:
            self._wanted[record.id] = record
            self._ask.set()

    async def _make(self) -> None:
        while True:
            await self._ask.wait()
            self._ask.clear()
            while self._wanted:
                record = next(iter(self._wanted.values()))
                try:
                    await self._copy(record)
                finally:
                    self._wanted.pop(record.id, None)

    async def _copy(self, record: CloudRecord) -> None:
        path = self._path(record.id)
        if path.is_file() or not await run_in_threadpool(self._make_room, self._size(record)):
            return
        start = time.monotonic()
        try:
            await to_process.run_sync(
                copy_bands, self._settings, record.prefix, path, cancellable=True, limiter=self._process
            )
        except (SpecimapError, BrokenWorkerProcess, OSError) as error:
            # Bands are read all the same, only slower.
            self._failed.add(record.id)
            logger().warning("a copy by bands was not made", cloud=record.id, error=type(error).__name__)
        else:
            logger().info("copied by bands", cloud=record.id, seconds=round(time.monotonic() - start, 2))

    def _make_room(self, size: int) -> bool:
        """Remove the copies that were used longest ago; return whether there is room for one more."""
        with suppress(OSError):
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in self._folder.glob("*.u2"))
            held = sum(item[1] for item in found)
            for _, bytes_of, path in found:
                if held + size <= self._settings.band_copies_bytes:
                    break
                remove(path)
                held -= bytes_of
            return shutil.disk_usage(self._folder).free - size >= self._settings.min_free_bytes
        return False

    async def _sweep(self) -> None:
        while True:
            with suppress(DatabaseUnavailableError, OSError):
                await run_in_threadpool(self._remove_orphans)
            await asyncio.sleep(SWEEP_SECONDS)

    def _remove_orphans(self) -> None:
        """Remove copies of clouds that were deleted, and what a killed process left aside."""
        copies = {path.stem: path for path in self._folder.glob("*.u2")}
        if copies:
            with self._database.session() as session:
                known = set(session.scalars(sa.select(CloudRow.id).where(CloudRow.id.in_(copies))))
            for cloud_id in copies.keys() - known:
                remove(copies[cloud_id])
        for aside in self._folder.glob(".*.tmp"):
            # As old as no copying takes.
            if time.time() - aside.stat().st_mtime > 3600:
                remove(aside)

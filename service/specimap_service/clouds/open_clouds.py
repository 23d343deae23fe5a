"""Open clouds, kept for later requests: their database records, files, and the arrays read so far."""

from __future__ import annotations

import datetime
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass

import sqlalchemy as sa

from specimap_core.cloud import Cloud
from specimap_core.cloud.shards import PointArray
from specimap_core.errors import CloudDamagedError, NotFoundError
from specimap_infra.database import Database
from specimap_infra.labels import current_labels
from specimap_infra.storage import Storage
from specimap_infra.tables import CloudRow, Job
from specimap_service.auth.access import not_found
from specimap_service.clouds.stored_folder import StoredFolder

KEPT_SECONDS = 2.0
"""How long a row is used without a new query: the delay of a deletion, and of a new label in other processes."""
MOST_CLOUDS = 64
MOST_BYTES = 1024**3
"""Memory of the arrays that open clouds keep, about 40 bytes a point; the one in use is kept in any case."""
_MOST_RECORDS = 4096
_MOST_LABELS = 256
_TRIM_SECONDS = 1.0


@dataclass(frozen=True)
class LabelRecord:
    """The current version of a label layer; ``prefix`` is its zarr array's folder in the storage."""

    name: str
    version: int
    kind: str
    prefix: str


@dataclass(frozen=True)
class CloudRecord:
    """The database record of a finished cloud, with its labels by name."""

    id: str
    job_id: str
    acquisition_id: str
    prefix: str
    points: int
    bands: int
    size: int
    created_at: datetime.datetime
    labels: Mapping[str, LabelRecord]

    @property
    def zarr(self) -> str:
        """The Zarr group's folder in the storage."""
        return f"{self.prefix}/cloud.zarr"


class OpenClouds:
    """Clouds by id. Safe to share between threads; a cloud that many request at once is opened once."""

    def __init__(self, storage: Storage, database: Database) -> None:
        self._storage = storage
        self._database = database
        self._lock = threading.Lock()
        self._records: OrderedDict[str, tuple[float, CloudRecord]] = OrderedDict()
        self._clouds: OrderedDict[str, Future[Cloud]] = OrderedDict()
        self._labels: OrderedDict[str, PointArray] = OrderedDict()
        self._trimmed = 0.0
        self._forgotten = 0

    def record(self, cloud_id: str) -> CloudRecord:
        """Return the database record of a cloud, at most two seconds old.

        Raises:
            NotFoundError: there is none, or its job did not succeed.
        """
        now = time.monotonic()
        with self._lock:
            found = self._records.get(cloud_id)
            if found is not None:
                if now < found[0]:
                    return found[1]
                # One thread queries the database; the others use the old record until it has answered.
                self._records[cloud_id] = now + KEPT_SECONDS / 4, found[1]
            forgotten = self._forgotten
        try:
            record = self._look_up(cloud_id)
        except NotFoundError:
            self.forget(cloud_id)
            raise
        with self._lock:
            # A record that was looked up before a change is not kept.
            if forgotten == self._forgotten:
                self._records[cloud_id] = now + KEPT_SECONDS, record
                self._records.move_to_end(cloud_id)
                if len(self._records) > _MOST_RECORDS:
                    self._records.popitem(last=False)
        return record

    def forget(self, cloud_id: str) -> None:
        """Drop everything kept of a cloud: it was deleted, or its labels changed."""
        with self._lock:
            self._forgotten += 1
            self._records.pop(cloud_id, None)
            self._clouds.pop(cloud_id, None)

    @contextmanager
    def reading(self, cloud_id: str) -> Iterator[tuple[CloudRecord, Cloud]]:
        """Open a cloud to read from within the block.

        Raises:
            NotFoundError: there is none, or it was deleted meanwhile.
            CloudDamagedError: a file of it is missing or broken; the reader's own message goes to the log only.
        """
        record = self.record(cloud_id)
        try:
            yield record, self._opened(record)
        except CloudDamagedError as error:
            raise self.damage_of(cloud_id, error) from error

    def damage_of(self, cloud_id: str, error: CloudDamagedError) -> CloudDamagedError:
        """Return what a client is told of a damaged cloud. Raises NotFoundError where it was deleted meanwhile."""
        self.forget(cloud_id)
        self.record(cloud_id)
        array = error.details.get("array")
        return CloudDamagedError(
            f"The array {array} of cloud {cloud_id} cannot be read." if array else f"{cloud_id} cannot be read.",
            advice="Run the job again; finished stages are not repeated.",
            **({"array": array} if array else {}),
        )

    def label_array(self, label: LabelRecord) -> PointArray:
        """Open the stored values of a label. Raises CloudDamagedError; call it within :meth:`reading`."""
        with self._lock:
            found = self._labels.get(label.prefix)
        if found is None:
            folder, _, name = label.prefix.rpartition("/")
            path = self._storage.path(folder)
            found = PointArray(StoredFolder(self._storage, folder) if path is None else path, name)
            with self._lock:
                self._labels[label.prefix] = found
                if len(self._labels) > _MOST_LABELS:
                    self._labels.popitem(last=False)
        return found

    # ---- inside ---------------------------------------------------------------------------------------

    def _opened(self, record: CloudRecord) -> Cloud:
        with self._lock:
            opening = self._clouds.get(record.id)
            first = opening is None
            if opening is None:
                opening = self._clouds[record.id] = Future()
            self._clouds.move_to_end(record.id)
            self._trim()
        if first:
            try:
                opening.set_result(self._open(record))
            except BaseException as error:
                with self._lock:
                    self._clouds.pop(record.id, None)
                opening.set_exception(error)
        return opening.result()

    def _open(self, record: CloudRecord) -> Cloud:
        path = self._storage.path(record.zarr)
        try:
            return Cloud.open(StoredFolder(self._storage, record.zarr) if path is None else path)
        except NotFoundError as error:
            raise CloudDamagedError("The cloud's files are gone.", advice="") from error

    def _trim(self) -> None:
        """Drop the least recently used clouds while they are too many or too large."""
        now = time.monotonic()
        if len(self._clouds) <= MOST_CLOUDS and now - self._trimmed < _TRIM_SECONDS:
            return
        self._trimmed = now
        sizes = {
            name: opening.result().kept_bytes
            for name, opening in self._clouds.items()
            if opening.done() and opening.exception() is None
        }
        kept = sum(sizes.values())
        for name in list(self._clouds)[:-1]:
            if len(self._clouds) <= MOST_CLOUDS and kept <= MOST_BYTES:
                return
            del self._clouds[name]
            kept -= sizes.get(name, 0)

    def _look_up(self, cloud_id: str) -> CloudRecord:
        columns = (
            CloudRow.id,
            CloudRow.job_id,
            CloudRow.acquisition_id,
            CloudRow.prefix,
            CloudRow.points,
            CloudRow.bands,
            CloudRow.size,
            CloudRow.created_at,
        )
        with self._database.session() as session:
            row = session.execute(
                sa.select(*columns)
                .join(Job, Job.id == CloudRow.job_id)
                .where(CloudRow.id == cloud_id, Job.state == "succeeded")
            ).one_or_none()
            if row is None:
                raise not_found(cloud_id)
            labels = {
                label.name: LabelRecord(label.name, label.version, label.kind, label.storage_prefix)
                for label in current_labels(session, cloud_id)
            }
        return CloudRecord(*row, labels=labels)

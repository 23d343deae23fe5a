"""Prometheus metrics, named ``specimap_<noun>_<verb>_<unit>``; those from the database are read on request."""

from __future__ import annotations

import time
from collections.abc import Iterator

import sqlalchemy as sa
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from specimap_infra.database import Database, database_seconds, utc_now
from specimap_infra.errors import DatabaseUnavailableError, StorageUnavailableError
from specimap_infra.housekeeping import count_rows, scratch_bytes
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    DICOM_STATES,
    JOB_STATES,
    Artefact,
    CloudRow,
    DicomInstance,
    DicomSet,
    Export,
    Job,
    LabelVersion,
    Lease,
    StoredFile,
)

REQUEST_BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 60)
COUNTED_SECONDS = 60.0
"""How long counts of large tables are served before they are counted again."""


class Metrics:
    """The metrics of one app."""

    def __init__(self, database: Database, storage: Storage, settings: ServiceSettings) -> None:
        self.registry = CollectorRegistry()
        self._requests = Histogram(
            "specimap_requests_handle_seconds",
            "Time to answer a request.",
            ("method", "route", "status"),
            buckets=REQUEST_BUCKETS,
            registry=self.registry,
        )
        self.uploaded = Counter("specimap_uploads_receive_bytes", "Bytes taken in by uploads.", registry=self.registry)
        self.judged = Counter(
            "specimap_files_judge_total", "Files judged on arrival, by verdict.", ("verdict",), registry=self.registry
        )
        self.registry.register(_FromDatabase(database, storage, settings))

    def observe_request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request; ``status`` 0: the client disconnected."""
        self._requests.labels(method, route, str(status)).observe(seconds)

    def text(self) -> bytes:
        """Return the metrics in Prometheus' text format."""
        return generate_latest(self.registry)


class _FromDatabase(Collector):
    def __init__(self, database: Database, storage: Storage, settings: ServiceSettings) -> None:
        self._database = database
        self._storage = storage
        self._settings = settings
        self._counted: dict[str, int] | None = None
        self._counted_at = 0.0
        self._scratch = 0

    def describe(self) -> list[GaugeMetricFamily]:
        """Describe nothing, so that registering does not query the database."""
        return []

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        """Yield queue, jobs, stages and storage; nothing while the database is unavailable."""
        try:
            yield from self._jobs()
            yield from self._stored()
            yield from self._outbox()
            yield from self._kept()
        except DatabaseUnavailableError:
            return

    def _jobs(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        with self._database.session() as session:
            by_state = session.execute(sa.select(Job.state, sa.func.count()).group_by(Job.state))
            counts = {row[0]: int(row[1]) for row in by_state}
            oldest = session.scalar(sa.select(sa.func.min(Job.created_at)).where(Job.state == "queued"))
            errors = session.scalars(sa.select(Job.error).where(Job.state == "failed")).all()
            seconds = session.scalars(sa.select(Job.seconds).where(Job.state == "succeeded")).all()
            # A lease outlives its worker where nobody is left to remove it.
            oldest_beat = database_seconds(self._database.engine) - self._settings.lease_seconds
            workers = session.scalar(sa.select(sa.func.count()).where(Lease.heartbeat >= oldest_beat))
        jobs = GaugeMetricFamily("specimap_jobs", "Jobs by state.", labels=("state",))
        for state in JOB_STATES:
            jobs.add_metric((state,), counts.get(state, 0))
        yield jobs
        age = (utc_now() - oldest).total_seconds() if oldest else 0.0
        yield GaugeMetricFamily("specimap_queue_wait_seconds", "Age of the oldest queued job.", value=max(age, 0.0))
        yield GaugeMetricFamily("specimap_workers", "Workers whose heartbeat is fresh.", value=workers or 0)
        failures = CounterMetricFamily("specimap_jobs_fail", "Failed jobs by code.", labels=("code",))
        by_code: dict[str, int] = {}
        for error in errors:
            code = str((error or {}).get("code", "unknown"))
            by_code[code] = by_code.get(code, 0) + 1
        for code, count in sorted(by_code.items()):
            failures.add_metric((code,), count)
        yield failures
        spent = CounterMetricFamily("specimap_stages_run_seconds", "Time spent in stages.", labels=("stage",))
        totals: dict[str, float] = {}
        for stages in seconds:
            for stage, value in stages.items():
                totals[stage] = totals.get(stage, 0.0) + float(value)
        for stage, total in sorted(totals.items()):
            spent.add_metric((stage,), total)
        yield spent

    def _stored(self) -> Iterator[GaugeMetricFamily]:
        with self._database.session() as session:
            sizes = {
                "files": session.scalar(sa.select(sa.func.sum(StoredFile.size))),
                "artefacts": session.scalar(sa.select(sa.func.sum(Artefact.size))),
                "clouds": session.scalar(sa.select(sa.func.sum(CloudRow.size))),
                "labels": session.scalar(sa.select(sa.func.sum(LabelVersion.size))),
                "exports": session.scalar(sa.select(sa.func.sum(Export.size))),
            }
        stored = GaugeMetricFamily("specimap_storage_use_bytes", "Stored bytes by kind.", labels=("kind",))
        for kind, size in sizes.items():
            stored.add_metric((kind,), float(size or 0))
        yield stored
        try:
            free = self._storage.free_bytes()
        except StorageUnavailableError:
            free = None
        if free is not None:
            yield GaugeMetricFamily("specimap_storage_free_bytes", "Free space of the storage.", value=float(free))

    def _outbox(self) -> Iterator[GaugeMetricFamily]:
        with self._database.session() as session:
            by_state = session.execute(sa.select(DicomInstance.state, sa.func.count()).group_by(DicomInstance.state))
            counts = {row[0]: int(row[1]) for row in by_state}
            oldest = session.scalar(sa.select(sa.func.min(DicomSet.created_at)).where(DicomSet.state == "waiting"))
            sets = session.execute(sa.select(DicomSet.state, sa.func.count()).group_by(DicomSet.state))
            by_set = {row[0]: int(row[1]) for row in sets}
        objects = GaugeMetricFamily("specimap_dicom_objects", "DICOM objects by state.", labels=("state",))
        results = GaugeMetricFamily("specimap_dicom_sets", "Sets of DICOM objects by state.", labels=("state",))
        for state in DICOM_STATES:
            objects.add_metric((state,), counts.get(state, 0))
            results.add_metric((state,), by_set.get(state, 0))
        yield objects
        yield results
        age = (utc_now() - oldest).total_seconds() if oldest else 0.0
        yield GaugeMetricFamily(
            "specimap_dicom_wait_seconds", "Age of the oldest set of DICOM objects that waits.", value=max(age, 0.0)
        )

    def _kept(self) -> Iterator[GaugeMetricFamily]:
        if self._counted is None or time.monotonic() - self._counted_at > COUNTED_SECONDS:
            with self._database.session() as session:
                self._counted = count_rows(session)
            self._scratch = scratch_bytes(self._settings)
            self._counted_at = time.monotonic()
        rows = GaugeMetricFamily("specimap_rows_keep", "Rows of what is kept by rule.", labels=("kind",))
        for kind, count in sorted(self._counted.items()):
            rows.add_metric((kind,), count)
        yield rows
        yield GaugeMetricFamily("specimap_scratch_use_bytes", "Bytes in the scratch folder.", value=self._scratch)

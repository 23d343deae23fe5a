"""Stored files of jobs and their results, removed together with their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.storage import Storage
from specimap_infra.tables import CloudRow, Export
from specimap_service.clouds.open_clouds import OpenClouds


@dataclass(frozen=True)
class JobFiles:
    """Prefixes of the storage, and the clouds that the app may hold open."""

    prefixes: tuple[str, ...]
    clouds: tuple[str, ...]

    @classmethod
    def of(cls, session: Session, jobs: Sequence[str]) -> JobFiles:
        """Find those of jobs, with their results, labels and exports; call it before the rows are deleted."""
        clouds = tuple(session.scalars(sa.select(CloudRow.id).where(CloudRow.job_id.in_(jobs))))
        exports = session.scalars(sa.select(Export.id).where(Export.cloud_id.in_(clouds)))
        places = {"jobs": jobs, "clouds": clouds, "exports": tuple(exports)}
        return cls(tuple(f"{place}/{name}" for place, names in places.items() for name in names), clouds)

    def remove(self, storage: Storage, clouds: OpenClouds) -> None:
        """Remove them. After the commit: a row that names missing files is worse than files that no row names.

        Raises:
            StorageUnavailableError: the rows are gone, but files may be left.
        """
        for cloud in self.clouds:
            clouds.forget(cloud)
        for prefix in self.prefixes:
            storage.delete(prefix)

"""What lies in the storage for jobs and their results, to be removed with their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.tables import CloudRow, Export
from specimap_service.context import AppContext


@dataclass(frozen=True)
class Leftovers:
    """Prefixes of the storage, and the clouds that the app may hold open."""

    prefixes: tuple[str, ...]
    clouds: tuple[str, ...]

    @classmethod
    def of(cls, session: Session, jobs: Sequence[str]) -> Leftovers:
        """Of jobs, with all that hangs on them: results, labels, exports. Read before the rows go."""
        clouds = tuple(session.scalars(sa.select(CloudRow.id).where(CloudRow.job_id.in_(jobs))))
        exports = session.scalars(sa.select(Export.id).where(Export.cloud_id.in_(clouds)))
        places = {"jobs": jobs, "clouds": clouds, "exports": tuple(exports)}
        return cls(tuple(f"{place}/{name}" for place, names in places.items() for name in names), clouds)

    def remove(self, context: AppContext) -> None:
        """Remove them. After the commit: a row that speaks of lost files is worse than files that no row speaks of.

        Raises:
            StorageUnavailableError: the rows are gone, but files may be left.
        """
        for cloud in self.clouds:
            context.clouds.forget(cloud)
        for prefix in self.prefixes:
            context.storage.delete(prefix)

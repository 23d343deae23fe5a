"""Label layers of a cloud: the highest version of each name is the current one."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import sqlalchemy as sa
from sqlalchemy.orm import Session, aliased

from specimap_core.errors import NotFoundError
from specimap_infra.tables import CloudRow, LabelVersion


def lock_cloud(session: Session, cloud_id: str) -> None:
    """Lock a cloud with its labels and exports until the transaction ends.

    Raises:
        NotFoundError: there is no such cloud.
    """
    # A write that changes nothing, since SQLite locks by writes only.
    row = session.execute(
        sa.update(CloudRow).where(CloudRow.id == cloud_id).values(points=CloudRow.points).returning(CloudRow.id),
        execution_options={"synchronize_session": False},
    )
    if row.first() is None:
        raise NotFoundError(f"There is no cloud {cloud_id}.", advice="GET /v1/clouds lists all.")


def current_labels(session: Session, cloud_id: str) -> list[LabelVersion]:
    """List the current version of each layer, by name."""
    other = aliased(LabelVersion)
    newest = (
        sa.select(sa.func.max(other.version))
        .where(other.cloud_id == LabelVersion.cloud_id, other.name == LabelVersion.name)
        .scalar_subquery()
    )
    query = sa.select(LabelVersion).where(LabelVersion.cloud_id == cloud_id, LabelVersion.version == newest)
    return list(session.scalars(query.order_by(LabelVersion.name)))


def fingerprint(labels: Iterable[LabelVersion]) -> str:
    """Return a hash that changes whenever a layer is added, removed or gets another version."""
    named = sorted(f"{row.name}={row.storage_prefix}" for row in labels)
    return hashlib.sha256("\n".join(named).encode()).hexdigest()

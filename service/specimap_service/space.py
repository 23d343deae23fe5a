"""Space for what arrives: the key's quota, and free bytes on the disks."""

from __future__ import annotations

import shutil

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors
from specimap_core.errors import StorageFullError
from specimap_infra.tables import ApiKey, LabelVersion, Person, StoredFile, Upload
from specimap_service.auth.keys import Principal
from specimap_service.context import AppContext
from specimap_service.errors import QuotaExceededError

DISK_EVERY = 64 * 1024 * 1024
"""Bytes of an arriving body after which the disks are looked at again."""


def check_quota(session: Session, principal: Principal, new: int) -> None:
    """Raise QuotaExceededError where ``new`` more bytes are over the quota. Locks the row of the key or person."""
    lock = (
        sa.update(Person).where(Person.id == principal.key_id).values(issuer=Person.issuer)
        if principal.is_person
        else sa.update(ApiKey).where(ApiKey.id == principal.key_id).values(name=ApiKey.name)
    )
    session.execute(lock, execution_options={"synchronize_session": False})
    if new > quota_left(session, principal):
        raise over_quota(principal, new)


def over_quota(principal: Principal, new: int) -> QuotaExceededError:
    """Make the error for ``new`` more bytes than the key's quota allows."""
    return QuotaExceededError(
        f"With {new} bytes more the key is over its quota of {principal.quota_bytes} bytes.",
        advice="Delete acquisitions or labels that are no longer needed, or ask the administrator for a higher quota.",
        quota_bytes=principal.quota_bytes,
    )


def quota_left(session: Session, principal: Principal) -> int:
    """Return the bytes that the key may still store; unfinished uploads count with their full size."""
    stored = session.scalar(sa.select(sa.func.sum(StoredFile.size)).where(StoredFile.created_by == principal.key_id))
    coming = session.scalar(
        sa.select(sa.func.sum(Upload.size)).where(Upload.created_by == principal.key_id, Upload.state == "open")
    )
    labels = session.scalar(
        sa.select(sa.func.sum(LabelVersion.size)).where(LabelVersion.created_by == principal.key_id)
    )
    return principal.quota_bytes - int(stored or 0) - int(coming or 0) - int(labels or 0)


def check_disks(context: AppContext, new: int, coming: int = 0) -> None:
    """Raise StorageFullError where ``new`` bytes, and those still ``coming``, leave less free than the reserve."""
    with disk_errors(context.settings.scratch):
        free = shutil.disk_usage(context.settings.scratch).free
    stored = context.storage.free_bytes()
    free = free if stored is None else min(free, stored)
    if free - coming - new < context.settings.min_free_bytes:
        raise StorageFullError(
            "The service's disk is too full for this file.",
            advice="Ask the administrator to free space; what has been uploaded so far is kept.",
        )

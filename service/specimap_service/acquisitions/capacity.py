"""Limits on arriving files and labels: size and number, the key's quota, free disk space."""

from __future__ import annotations

import shutil

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError, StorageFullError
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import Acquisition, ApiKey, LabelVersion, StoredFile, Upload
from specimap_service.auth.keys import Principal
from specimap_service.context import AppContext
from specimap_service.errors import PayloadTooLargeError, QuotaExceededError

DISK_EVERY = 64 * 1024 * 1024
"""Bytes of an arriving body after which the disks are looked at again."""


def locked_acquisition(session: Session, acquisition_id: str) -> Acquisition:
    """Return the acquisition, its row locked until the transaction ends. Raises NotFoundError.

    The lock is taken by a write that changes nothing: SQLite begins a transaction at the first write only.
    """
    session.execute(
        sa.update(Acquisition).where(Acquisition.id == acquisition_id).values(notes=Acquisition.notes),
        execution_options={"synchronize_session": False},
    )
    found = session.get(Acquisition, acquisition_id)
    if found is None:
        raise no_acquisition(acquisition_id)
    return found


def no_acquisition(acquisition_id: str) -> NotFoundError:
    """Make the error for an unknown acquisition."""
    return NotFoundError(f"There is no acquisition {acquisition_id}.", advice="GET /v1/acquisitions lists all.")


def max_file_bytes(settings: ServiceSettings, role: str) -> int:
    """Return the most bytes that a file of a role may have."""
    return settings.max_photo_bytes if role == "photo" else settings.max_cube_bytes


def check_size(settings: ServiceSettings, role: str, size: int) -> None:
    """Raise PayloadTooLargeError where a file is larger than its role allows."""
    limit = max_file_bytes(settings, role)
    if size > limit:
        what = "photo" if role == "photo" else "cube file"
        raise PayloadTooLargeError(
            f"A {what} holds at most {limit} bytes here, this one {size}.",
            advice="Give the file as the camera made it, or ask the administrator for a higher limit.",
            limit_bytes=limit,
            size=size,
        )


def check_count(session: Session, settings: ServiceSettings, acquisition_id: str, new: int) -> None:
    """Raise QuotaExceededError where ``new`` more photos are too many; those still being uploaded count."""
    stored = session.scalar(
        sa.select(sa.func.count()).where(StoredFile.acquisition_id == acquisition_id, StoredFile.role == "photo")
    )
    coming = session.scalar(
        sa.select(sa.func.count()).where(
            Upload.acquisition_id == acquisition_id, Upload.role == "photo", Upload.state == "open"
        )
    )
    if (stored or 0) + (coming or 0) + new > settings.max_photos:
        raise QuotaExceededError(
            f"An acquisition holds at most {settings.max_photos} photos.",
            advice="Delete photos, refused ones first, or make another acquisition.",
            limit=settings.max_photos,
        )


def check_quota(session: Session, principal: Principal, new: int) -> None:
    """Raise QuotaExceededError where ``new`` more bytes are over the key's quota. Locks the key's row."""
    session.execute(
        sa.update(ApiKey).where(ApiKey.id == principal.key_id).values(name=ApiKey.name),
        execution_options={"synchronize_session": False},
    )
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

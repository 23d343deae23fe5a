"""Limits on arriving files: their size and number."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import Acquisition, StoredFile, Upload
from specimap_service.auth.access import not_found
from specimap_service.errors import PayloadTooLargeError, QuotaExceededError


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
        raise not_found(acquisition_id)
    return found


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

"""Removal of uploads that are due, and of what killed processes left."""

from __future__ import annotations

import shutil
import time
from contextlib import suppress
from pathlib import Path

import sqlalchemy as sa

from specimap_core.errors import NotFoundError, SpecimapError
from specimap_infra.database import utc_now
from specimap_infra.housekeeping import sweep_leftovers
from specimap_infra.logs import logger
from specimap_infra.tables import Upload
from specimap_service.uploads.lifecycle import Uploads

ABANDONED_SECONDS = 3600.0


def sweep(uploads: Uploads) -> None:
    """Expire uploads that are due, and remove files that killed processes left. Processes may do so at once."""
    with uploads.context.database.session() as session:
        rows = session.execute(sa.select(Upload.id, Upload.size, Upload.expires_at).where(Upload.state == "open")).all()
    due = [row for row in rows if row.expires_at <= utc_now()]
    for row in due:
        if uploads.files.size(row.id) == row.size:
            # Whole, but its process died before the file was stored.
            with suppress(SpecimapError):
                uploads.finish(row.id)
            continue
        with suppress(NotFoundError):
            held = uploads.files.try_lock(row.id)
            if held is None:  # another request is writing to it
                continue
            held.close()
        uploads.expire(row.id)
    uploads.files.sweep({row.id for row in rows}, ABANDONED_SECONDS)
    judging = uploads.context.settings.scratch / "judging"
    for folder in judging.iterdir() if judging.is_dir() else ():
        _remove_old(folder)
    sweep_leftovers(uploads.context.settings, uploads.context.storage)
    if due:
        logger().info("uploads swept", expired=len(due))


def _remove_old(folder: Path) -> None:
    with suppress(FileNotFoundError):
        if time.time() - folder.stat().st_mtime > ABANDONED_SECONDS:
            shutil.rmtree(folder, ignore_errors=True)

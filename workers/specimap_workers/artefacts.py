"""Artefacts of finished stages in the common storage: found again by key, one for each stage of an acquisition."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_core.pipeline.artefact_store import Store
from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.jobs import held
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, Artefact

SAVED = ("reconstruct", "adjust", "render")
"""Stages that leave an artefact; the last one leaves the result."""


@dataclass(frozen=True)
class Artefacts:
    """The artefacts that one job reads and writes."""

    database: Database
    storage: Storage
    acquisition_id: str

    def seconds(self, stage: str, key: str) -> float | None:
        """How long the stage took when it left an artefact of that key; None where there is none."""
        row = self._row(stage, key)
        if row is None:
            return None
        try:
            self.storage.stat(row.storage_key)
        except NotFoundError:
            return None
        return row.seconds

    def fetch(self, stage: str, key: str, folder: Path) -> bool:
        """Bring an artefact into a work folder; false where there is none."""
        target = Store(folder / "stages").path(stage, key)
        if target.exists():
            return True
        row = self._row(stage, key)
        if row is None:
            return False
        try:
            self.storage.fetch(row.storage_key, target)
        except NotFoundError:
            return False
        return True

    def keep(self, stage: str, key: str, folder: Path, seconds: float, job_id: str, executor: str) -> None:
        """Store what a stage left in a work folder, in place of what other settings left before.

        Raises:
            LostLeaseError: the job is not this executor's any more; nothing has changed then.
        """
        source = Store(folder / "stages").path(stage, key)
        size = source.stat().st_size
        storage_key = f"acquisitions/{self.acquisition_id}/stages/{new_id('att')}.npz"
        copy = source.with_name(f".{source.name}.copy.tmp")
        copy.unlink(missing_ok=True)  # of an attempt that the storage refused
        try:
            os.link(source, copy)
        except OSError:
            shutil.copyfile(source, copy)
        self.storage.put_file(storage_key, copy)
        try:
            with self.database.session() as session:
                self._alone(session)
                job = held(session, job_id, executor)
                of_stage = sa.and_(Artefact.acquisition_id == self.acquisition_id, Artefact.stage == stage)
                old = list(session.scalars(sa.select(Artefact.storage_key).where(of_stage)))
                session.execute(sa.delete(Artefact).where(of_stage))
                session.add(
                    Artefact(
                        id=new_id("att"),
                        acquisition_id=self.acquisition_id,
                        stage=stage,
                        key=key,
                        storage_key=storage_key,
                        size=size,
                        seconds=seconds,
                    )
                )
                # They count from the last finished stage: a job that gets on is sound.
                job.setbacks = {}
                job.seconds = {**job.seconds, stage: round(seconds, 3)}
        except BaseException:
            self.storage.delete(storage_key)
            raise
        for key_before in old:
            self.storage.delete(key_before)

    def _alone(self, session: Session) -> None:
        """Let no other job of this acquisition replace an artefact until the transaction ends.

        Of two that do so at once, neither would see the row of the other. The acquisition is locked before the job, in
        the order in which removing an acquisition locks them; SQLite has one writer at a time anyway.
        """
        session.execute(
            sa.select(Acquisition.id).where(Acquisition.id == self.acquisition_id).with_for_update(key_share=True)
        )

    def _row(self, stage: str, key: str) -> Artefact | None:
        with self.database.session() as session:
            return session.scalar(
                sa.select(Artefact).where(
                    Artefact.acquisition_id == self.acquisition_id, Artefact.stage == stage, Artefact.key == key
                )
            )

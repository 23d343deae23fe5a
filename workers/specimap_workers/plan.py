"""The inputs of a job: its files, its settings, and the keys of its stages; all from the database's rows."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text
from specimap_core.pipeline.keys import digest_of, register_key, surface_keys
from specimap_core.pipeline.options import RunOptions
from specimap_core.pipeline.settings import settings_from
from specimap_core.reconstruct.backends.environment import BackendSettings
from specimap_infra.database import Database
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, Job, StoredFile


@dataclass(frozen=True)
class Plan:
    """``files``: where in the work folder each stored file goes; ``keys``: of the four stages' artefacts."""

    job_id: str
    acquisition_id: str
    files: dict[str, str]
    settings: dict[str, Any]
    keys: dict[str, str]
    hashes: dict[str, str]

    def inputs(self, folder: Path) -> dict[str, str]:
        """The pipeline's inputs in a work folder: ``photos``, ``cube`` and, where there are some, the references."""
        found = {"photos": str(folder / "photos")}
        for role in ("cube", "white", "dark"):
            paths = sorted(p for p in self.files if p.startswith(f"{role}/"))
            if paths:
                # An ENVI header stands for its data, too.
                found[role] = str(folder / next((p for p in paths if p.endswith(".hdr")), paths[0]))
        return found

    def fetch(self, storage: Storage, folder: Path) -> None:
        """Bring the files that are not there yet.

        Raises:
            NotFoundError: a file was deleted meanwhile.
        """
        for place, key in self.files.items():
            if not (folder / place).exists():
                storage.fetch(key, folder / place)


def plan_of(database: Database, job_id: str, backends: BackendSettings) -> Plan:
    """The plan of a job on a machine with these backends.

    Raises:
        NotFoundError: the job, or its acquisition's cube or photos, are gone.
        SettingsError, UnknownDictionaryError: the job's settings cannot be.
        BackendUnavailableError: the job's backend, or its weights, are not on this machine.
    """
    with database.session() as session:
        job = session.get_one(Job, job_id)
        acquisition = session.get_one(Acquisition, job.acquisition_id)
        rows = session.scalars(
            sa.select(StoredFile)
            .where(StoredFile.acquisition_id == acquisition.id, StoredFile.state == "accepted")
            .order_by(StoredFile.label)
        ).all()
    # Out of the transaction: the hash of a backend's weights takes seconds the first time.
    files = {f"{'photos' if row.role == 'photo' else row.role}/{row.label}": row.storage_key for row in rows}
    photos = {row.label: row.sha256 for row in rows if row.role == "photo"}
    cube = {row.label: row.sha256 for row in rows if row.role != "photo"}
    if not photos or not any(row.role == "cube" for row in rows):
        raise NotFoundError("The acquisition's photos or its cube are gone.", advice="Upload them, then rerun the job.")
    chosen: dict[str, Any] = {name: value for name, value in job.settings.items() if value is not None}
    options = RunOptions(**{"edge_mm": acquisition.edge_mm, "dictionary": acquisition.dictionary, **chosen})
    settings = settings_from(options, backends.device)
    keys = surface_keys(photos, settings, backends)
    digest = hashlib.sha256(json_text(cube, sort_keys=True).encode()).hexdigest()
    keys["register"] = register_key(keys["render"], digest, settings)
    return Plan(
        job.id,
        acquisition.id,
        files,
        asdict(options),
        keys,
        {"cube": digest, "photos": digest_of(photos), "acquisition": acquisition.id, "job": job.id},
    )

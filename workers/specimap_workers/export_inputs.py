"""What an export is made from, fetched into its workspace."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import sqlalchemy as sa

from specimap_core.atomic import remove
from specimap_core.cloud.schema import ARRAYS
from specimap_core.errors import NotFoundError
from specimap_core.export.deidentified.plan import Plan
from specimap_core.export.formats import DEIDENTIFIED, WITH_LABELS, FileFormat
from specimap_infra.database import Database
from specimap_infra.export_state import state_hash
from specimap_infra.labels import current_labels
from specimap_infra.pseudonyms import Pseudonyms
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, CloudRow, StoredFile

DOCUMENTS = (FileFormat.HTML, FileFormat.PDF)


class LostError(Exception):
    """The row is another executor's now, or gone."""


def fetch_inputs(
    database: Database, storage: Storage, settings: ServiceSettings, cloud_id: str, format: FileFormat, work: Path
) -> str:
    """Put what the format is made from into ``work``; return the hash of what it depends on beside the result.

    Raises:
        LostError: the cloud is gone.
        SettingsError: the format needs the key of pseudonyms, and there is none.
    """
    with database.session() as session:
        cloud = session.get(CloudRow, cloud_id)
        labels = current_labels(session, cloud_id) if format in WITH_LABELS else []
    if cloud is None:
        raise LostError
    state = state_hash(format, labels, settings)
    if format.startswith("mesh-"):
        storage.fetch(f"{cloud.prefix}/mesh.ply", work / "mesh.ply")
        return state
    if format in DOCUMENTS:
        _fetch_drawn(storage, cloud.prefix, work)
        return state
    storage.fetch(f"{cloud.prefix}/cloud.zarr", work / "cloud.zarr")
    try:
        for label in labels:
            storage.fetch(label.storage_prefix, work / "cloud.zarr" / "labels" / label.name)
    except NotFoundError:
        # A layer was deleted since the rows were read. Where it was not, this ends with the error.
        with database.session() as session:
            if state_hash(format, current_labels(session, cloud_id), settings) == state:
                raise
        remove(work / "cloud.zarr")
        return fetch_inputs(database, storage, settings, cloud_id, format, work)
    if format in DEIDENTIFIED:
        _fetch_identified(database, storage, settings, cloud, format, work)
    return state


def _fetch_drawn(storage: Storage, prefix: str, work: Path) -> None:
    """What a report is drawn from: all but the spectra, which are nearly all of a cloud."""
    for name in ("zarr.json", "spectra/zarr.json", *(array for array in ARRAYS if array != "spectra")):
        storage.fetch(f"{prefix}/cloud.zarr/{name}", work / "cloud.zarr" / name)
    storage.fetch(f"{prefix}/report.json", work / "report.json")
    for name in ("photos.jpg", "preview.png"):  # older results have no photos
        with suppress(NotFoundError):
            storage.fetch(f"{prefix}/{name}", work / name)


def _fetch_identified(
    database: Database, storage: Storage, settings: ServiceSettings, cloud: CloudRow, format: FileFormat, work: Path
) -> None:
    """The rest of a de-identified export's inputs, and its plan: the key stays out of the process that makes it."""
    for name in ("mesh.ply", "report.json", "cameras.json", "corners.json", "preview.png", "photos.jpg"):
        with suppress(NotFoundError):
            storage.fetch(f"{cloud.prefix}/{name}", work / name)
    with database.session() as session:
        acquisition = session.get(Acquisition, cloud.acquisition_id)
        files = session.scalars(
            sa.select(StoredFile)
            .where(StoredFile.acquisition_id == cloud.acquisition_id, StoredFile.state == "accepted")
            .order_by(StoredFile.label)
        ).all()
    if acquisition is None:
        raise LostError
    with_inputs = format is FileFormat.DEIDENTIFIED_INPUTS
    if with_inputs:
        for row in files:
            storage.fetch(row.storage_key, work / ("photos" if row.role == "photo" else row.role) / row.label)
    names, specimen = Pseudonyms.of(settings), acquisition.specimen_id
    Plan(
        specimen=names.of_text("specimen", specimen),
        acquisition=names.of_text("acquisition", acquisition.id),
        result=names.of_text("result", cloud.id),
        captured=names.shifted(specimen, acquisition.created_at).isoformat(),
        made=names.shifted(specimen, cloud.created_at).isoformat(),
        dictionary=acquisition.dictionary,
        edge_mm=acquisition.edge_mm,
        photos={
            row.label: f"photo-{number:03d}"
            for number, row in enumerate((row for row in files if row.role == "photo"), 1)
        },
        inputs=with_inputs,
    ).write(work)

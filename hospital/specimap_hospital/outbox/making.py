"""Makes the objects of a set: the result's files from the storage, and a confined process that reads them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from specimap_core import __version__
from specimap_core.cloud.schema import ARRAYS
from specimap_core.errors import NotFoundError
from specimap_hospital.dicom.confined import Limits, build_confined
from specimap_hospital.dicom.model import BandChoice, BuildTask, DicomObject, ResultSource, SegmentClass
from specimap_infra.database import Database
from specimap_infra.errors import StudyMissingError
from specimap_infra.labels import current_labels
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.studies import find_study, study_keys
from specimap_infra.study_context import StudyContext
from specimap_infra.tables import Acquisition, CloudRow, LabelVersion, StoredFile

FILES = ("mesh.ply", "report.json", "corners.json")
MAYBE = ("photos.jpg", "preview.png", "cameras.json")
BUILD_SECONDS = 900.0


def make_objects(
    database: Database,
    storage: Storage,
    settings: ServiceSettings,
    cloud_id: str,
    options: Mapping[str, Any],
    folder: Path,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    archive: str | None = None,
) -> list[DicomObject]:
    """Make the objects of a cloud in the folder ``folder``; ``options`` as of :func:`task_of`.

    ``archive``: the name of a ZIP of all of them, made beside them.

    Raises:
        NotFoundError: the cloud, a file or a layer of it is gone. StudyMissingError: it has no study context.
        StudyKeysMissingError, StudySealedError: the study context does not open.
        CancelledError: ``cancelled`` came true.
        DatabaseUnavailableError, StorageUnavailableError, StorageFullError: try again later.
        SpecimapError: as :func:`specimap_hospital.dicom.confined.build_confined`.
    """
    context, row, photos, labels = _rows(database, settings, cloud_id)
    given, task = folder / "given", replace(task_of(options, labels), archive=archive)
    source = ResultSource(
        folder=given,
        photos=_fetched_photos(storage, photos, folder / "photos"),
        acquisition_id=row.acquisition_id,
        specimen_id=_specimen(database, row.acquisition_id),
        cloud_id=cloud_id,
        job_id=row.job_id,
        created=row.created_at,
        software_version=__version__,
    )
    _fetch_result(storage, row.prefix, given, whole=bool(options))
    for label in labels if options else []:
        storage.fetch(label.storage_prefix, given / "cloud.zarr" / "labels" / label.name)
    limits = Limits(settings.sandbox, settings.private_places, settings.stage_memory_bytes, BUILD_SECONDS)
    return build_confined(task, context, source, folder / "objects", limits, cancelled=cancelled)


def task_of(options: Mapping[str, Any], labels: list[LabelVersion]) -> BuildTask:
    """What is built: the first set; with ``bands``, or ``label`` and ``columns``, a parametric map; with ``label`` of a
    layer of classes, a segmentation.

    Raises:
        NotFoundError: there is no such layer.
    """
    if not options:
        return BuildTask()
    name = options.get("label")
    label = next((label for label in labels if label.name == name), None)
    if name is not None and label is None:
        raise NotFoundError("The cloud has no such label layer.", advice="GET the labels of the cloud lists all.")
    if label is not None and label.kind == "class":
        classes = [SegmentClass(int(c["value"]), str(c["name"]), c.get("colour")) for c in label.classes]
        return BuildTask("segmentation", label=label.name, classes=tuple(classes))
    if label is not None:
        names = {number: str(c["name"]) for number, c in enumerate(label.classes)}
        columns = options.get("columns") or list(names) or [0]
        return BuildTask(
            "parametric_map",
            BandChoice(label=label.name, columns={int(k): names.get(int(k), f"column {k}") for k in columns}),
        )
    return BuildTask("parametric_map", BandChoice(bands=tuple(options.get("bands", ()))))


def _rows(
    database: Database, settings: ServiceSettings, cloud_id: str
) -> tuple[StudyContext, CloudRow, list[StoredFile], list[LabelVersion]]:
    keys = study_keys(settings)
    with database.session() as session:
        row = session.get(CloudRow, cloud_id)
        if row is None:
            raise NotFoundError(f"There is no cloud {cloud_id}.", advice="It was deleted.")
        study = find_study(session, keys, row.acquisition_id)
        if study is None:
            raise StudyMissingError(
                "The acquisition has no study context any more.", advice="PUT one, and ask for the objects again."
            )
        photos = sa.select(StoredFile).where(
            StoredFile.acquisition_id == row.acquisition_id, StoredFile.role == "photo", StoredFile.state == "accepted"
        )
        files = list(session.scalars(photos.order_by(StoredFile.label)))
        return study.context, row, files, current_labels(session, cloud_id)


def _specimen(database: Database, acquisition_id: str) -> str:
    with database.session() as session:
        return session.scalar(sa.select(Acquisition.specimen_id).where(Acquisition.id == acquisition_id)) or ""


def _fetched_photos(storage: Storage, photos: list[StoredFile], folder: Path) -> dict[str, Path]:
    fetched = {}
    for photo in photos:
        # One that was deleted meanwhile is left out.
        with suppress(NotFoundError):
            storage.fetch(photo.storage_key, folder / photo.label)
            fetched[photo.label] = folder / photo.label
    return fetched


def _fetch_result(storage: Storage, prefix: str, folder: Path, *, whole: bool) -> None:
    """All that objects are made of. The spectra, which are nearly all of a result, are in those on request alone."""
    if whole:
        storage.fetch(f"{prefix}/cloud.zarr", folder / "cloud.zarr")
    else:
        fetch_without_spectra(storage, prefix, folder)
    for name in FILES:
        storage.fetch(f"{prefix}/{name}", folder / name)
    for name in MAYBE:
        with suppress(NotFoundError):
            storage.fetch(f"{prefix}/{name}", folder / name)


def fetch_without_spectra(storage: Storage, prefix: str, folder: Path) -> None:
    """Fetch a cloud but for its spectra to ``folder / "cloud.zarr"``. Raises NotFoundError, StorageUnavailableError."""
    for name in ("zarr.json", "spectra/zarr.json", *(array for array in ARRAYS if array != "spectra")):
        storage.fetch(f"{prefix}/cloud.zarr/{name}", folder / "cloud.zarr" / name)

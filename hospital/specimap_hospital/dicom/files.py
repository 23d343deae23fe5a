"""Objects as files: written whole or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydicom import Dataset

from specimap_core.atomic import atomic_path
from specimap_hospital.dicom.header import Header
from specimap_hospital.dicom.model import DicomObject, Kind


@dataclass(frozen=True)
class Written:
    """An object and its file. ``dataset`` without pixels or documents, for objects that refer to it."""

    made: DicomObject
    dataset: Dataset


BULK = ("PixelData", "FloatPixelData", "EncapsulatedDocument", "ICCProfile")


def write_dataset(header: Header, dataset: Dataset, kind: Kind, target: Path, transfer_syntax: str) -> Written:
    """Write an object to ``target``.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    dataset.file_meta = header.file_meta(dataset, transfer_syntax)
    with atomic_path(target) as aside:
        dataset.save_as(aside, enforce_file_format=True)
    made = DicomObject(
        sop_class_uid=str(dataset.SOPClassUID),
        sop_instance_uid=str(dataset.SOPInstanceUID),
        series_uid=str(dataset.SeriesInstanceUID),
        study_uid=str(dataset.StudyInstanceUID),
        kind=kind,
        path=target,
    )
    for name in BULK:
        if name in dataset:
            delattr(dataset, name)
    return Written(made, dataset)

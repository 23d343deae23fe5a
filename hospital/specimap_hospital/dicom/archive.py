"""Objects as a ZIP with a DICOMDIR, as on a disc: viewers open it, and the names in it say nothing of the patient."""

from __future__ import annotations

import zipfile
from collections import abc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from pydicom import Dataset, dcmread
from pydicom.fileset import DIRECTORY_RECORDERS, FileSet, RecordNode
from pydicom.sequence import Sequence

from specimap_core.export.archive import write_files_zip
from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.dicom.uids import derived_uid

FILE_SET_ID = "SPECIMAP"
UNKNOWN_PATIENT = "UNKNOWN"
"""A DICOMDIR names a patient id and a time of the study, which an object may lack."""
UNKNOWN_TIME = "000000"
_RECORD_TYPES = {
    "mesh": "ENCAP DOC",
    "report": "ENCAP DOC",
    "measurements": "SR DOCUMENT",
    "key_objects": "KEY OBJECT DOC",
}


def write_zip(objects: abc.Sequence[DicomObject], target: Path) -> Path:
    """Write the objects as a ZIP with a DICOMDIR, under names that say nothing of the patient.

    Raises:
        StorageFullError, OutputNotWritableError: ``target`` cannot be written.
    """
    with TemporaryDirectory() as folder, _file_set() as files:
        files.ID = FILE_SET_ID
        files.UID = derived_uid("file-set", *(made.sop_instance_uid for made in objects))  # type: ignore[assignment]
        for made in objects:
            dataset = dcmread(made.path)
            files.add_custom(dataset, _leaf(dataset, made.kind))
        files.write(folder)
        found = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        named = [(path.relative_to(folder).as_posix(), path) for path in found]
        return write_files_zip(target, named, {}, zipfile.ZIP_DEFLATED)


@contextmanager
def _file_set() -> Iterator[FileSet]:
    """An empty set whose files of its own are removed at the end; the library leaves that to the collector."""
    files = FileSet()
    try:
        yield files
    finally:
        files._stage["t"].cleanup()


def _leaf(dataset: Dataset, kind: str) -> RecordNode:
    """The directory's record of an object, below those of its series, study and patient."""
    patient, study, series = Dataset(), Dataset(), Dataset()
    patient.PatientName, patient.PatientID = dataset.PatientName, dataset.PatientID or UNKNOWN_PATIENT
    for name in ("StudyDate", "StudyInstanceUID", "StudyID", "AccessionNumber"):
        setattr(study, name, dataset.get(name))
    study.StudyTime = dataset.StudyTime or UNKNOWN_TIME
    study.StudyDescription = dataset.get("StudyDescription")
    for name in ("Modality", "SeriesInstanceUID", "SeriesNumber", "SeriesDescription"):
        setattr(series, name, dataset.get(name))
    kind_of_record = _RECORD_TYPES.get(kind, "IMAGE")
    leaf = DIRECTORY_RECORDERS[kind_of_record](dataset)
    leaf.ReferencedSOPInstanceUIDInFile = dataset.SOPInstanceUID
    if "ContentSequence" in leaf:
        # The library copies the whole report into the directory, which wants what its title is modified by alone.
        modifiers = [item for item in leaf.ContentSequence if item.RelationshipType == "HAS CONCEPT MOD"]
        leaf.ContentSequence = Sequence(modifiers)
        if not modifiers:
            del leaf.ContentSequence
    node: RecordNode | None = None
    for record, name in ((patient, "PATIENT"), (study, "STUDY"), (series, "SERIES"), (leaf, kind_of_record)):
        record.DirectoryRecordType = name
        record.SpecificCharacterSet = dataset.SpecificCharacterSet
        below = RecordNode(record)
        if node is not None:
            below.parent = node
        node = below
    assert node is not None
    return node

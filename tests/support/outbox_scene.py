"""Results that wait to be sent, a clock that tests set, and small DICOM objects in the place of a result's own."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from pathlib import Path
from typing import Any

from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.dicom.uids import derived_uid
from specimap_hospital.outbox.rows import Claim
from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.studies import put_study, study_keys
from specimap_infra.tables import Acquisition, CloudRow, Job
from tests.support.hospital_scene import PATIENT
from tests.support.service_scene import Running

SECONDARY_CAPTURE = "1.2.840.10008.5.1.4.1.1.7"


class Clock:
    """A time that stands still until it is moved."""

    def __init__(self, now: datetime.datetime | None = None) -> None:
        self.now = now or utc_now()

    def __call__(self) -> datetime.datetime:
        return self.now

    def advance(self, seconds: float) -> None:
        """Move it on."""
        self.now += datetime.timedelta(seconds=seconds)


def with_settings(settings: ServiceSettings | None, **given: object) -> ServiceSettings:
    """Settings, with others in their place."""
    before: dict[str, Any] = {} if settings is None else settings.model_dump()
    return load_settings(**{**before, **given})


def waiting_cloud(running: Running) -> str:
    """A result with a study context, without files. Its id."""
    return add_cloud(running.database, running.settings)


def add_cloud(database: Database, settings: ServiceSettings) -> str:
    """The same in a database."""
    acquisition, job, cloud = new_id("acq"), new_id("job"), new_id("cloud")
    with database.session() as session:
        session.add(
            Acquisition(
                id=acquisition,
                project_id=DEFAULT_PROJECT,
                specimen_id="S-1",
                accession_number=None,
                dictionary="DICT_4X4_50",
                edge_mm=6.8,
                notes="",
                created_by="key_test",
            )
        )
        session.flush()
        session.add(
            Job(
                id=job,
                acquisition_id=acquisition,
                settings={},
                priority=5,
                state="succeeded",
                request_hash="",
                correlation_id="",
                finished_at=utc_now(),
                created_by="key_test",
            )
        )
        session.flush()
        session.add(
            CloudRow(
                id=cloud,
                job_id=job,
                acquisition_id=acquisition,
                prefix=f"jobs/{job}/register/x",
                points=1,
                bands=1,
                size=1,
                report={},
            )
        )
        put_study(session, study_keys(settings), acquisition, PATIENT, "key_test")
    return cloud


def small_objects(held: Claim, folder: Path, cancelled: Callable[[], bool], count: int = 3) -> list[DicomObject]:
    """Small pictures as the objects of a set."""
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import UID, ExplicitVRLittleEndian

    made = []
    study, series = derived_uid("study", held.cloud_id), derived_uid("series", held.cloud_id)
    for number in range(count):
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = UID(SECONDARY_CAPTURE)
        meta.MediaStorageSOPInstanceUID = UID(derived_uid("instance", held.cloud_id, str(number)))
        meta.TransferSyntaxUID = ExplicitVRLittleEndian
        dataset = FileDataset("", {}, file_meta=meta, preamble=b"\0" * 128)
        dataset.SOPClassUID, dataset.SOPInstanceUID = SECONDARY_CAPTURE, meta.MediaStorageSOPInstanceUID
        dataset.StudyInstanceUID, dataset.SeriesInstanceUID = study, series
        dataset.PatientID, dataset.PatientName, dataset.Modality = f"V{held.study_version}", "Doe^Jane", "OT"
        dataset.Rows = dataset.Columns = 2
        dataset.SamplesPerPixel, dataset.PhotometricInterpretation = 1, "MONOCHROME2"
        dataset.BitsAllocated = dataset.BitsStored = 8
        dataset.HighBit, dataset.PixelRepresentation = 7, 0
        dataset.PixelData = bytes(4)
        path = folder / f"{number}.dcm"
        dataset.save_as(path, enforce_file_format=True)
        made.append(DicomObject(SECONDARY_CAPTURE, str(dataset.SOPInstanceUID), series, study, "photo", path))
    return made

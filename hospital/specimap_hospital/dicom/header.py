"""The modules that all objects share: patient, study, series, equipment, specimen."""

from __future__ import annotations

import datetime
import re
from dataclasses import dataclass

from pydicom import Dataset
from pydicom.dataset import FileMetaDataset
from pydicom.sequence import Sequence
from pydicom.uid import UID

from specimap_hospital.dicom.codes import SPECIMEN_CONTAINER
from specimap_hospital.dicom.model import ResultSource
from specimap_hospital.dicom.uids import IMPLEMENTATION_CLASS_UID, REVISION, derived_uid, study_uid
from specimap_infra.study_context import StudyContext

MANUFACTURER = "Specimap"
NO_SERIAL_NUMBER = "none"
"""A program has none, but some objects must hold one."""
RESEARCH = "research use only"
_LONG_STRING = 64


@dataclass(frozen=True)
class Series:
    """A series of the first set or beside it. ``role`` goes into its UID."""

    role: str
    number: int
    modality: str
    description: str


PHOTOS = Series("photos", 1, "XC", f"Photos of the specimen ({RESEARCH})")
TOP_VIEW = Series("top-view", 2, "OT", f"Top view with markers, from photos ({RESEARCH})")
PREVIEW = Series("preview", 3, "OT", f"Spectral preview, principal components ({RESEARCH})")
MESH = Series("mesh", 4, "M3D", f"Surface, STL in mm ({RESEARCH})")
MEASUREMENTS = Series("measurements", 5, "SR", f"Accuracy at the markers ({RESEARCH})")
REPORT = Series("report", 6, "DOC", f"Accuracy report ({RESEARCH})")
KEY_OBJECTS = Series("key-objects", 7, "KO", f"Look at these first ({RESEARCH})")


@dataclass(frozen=True)
class Header:
    """Writes the shared modules of a result's objects."""

    context: StudyContext
    source: ResultSource

    @property
    def study_uid(self) -> str:
        """As of :func:`~specimap_hospital.dicom.uids.study_uid`."""
        return study_uid(self.context, self.source)

    @property
    def specimen_identifier(self) -> str:
        """Of the order, or of the acquisition."""
        return self.context.specimen_identifier or self.source.specimen_id

    @property
    def specimen_uid(self) -> str:
        """Of the order, or one of the acquisition."""
        return self.context.specimen_uid or derived_uid("specimen", self.source.acquisition_id)

    @property
    def container_identifier(self) -> str:
        """Of the order, or the specimen's."""
        return self.context.container_identifier or self.specimen_identifier

    @property
    def device_uid(self) -> str:
        """Of the program, as an observer."""
        return derived_uid("device")

    @property
    def frame_of_reference_uid(self) -> str:
        """Of the result's marker frame."""
        return derived_uid("frame", self.source.cloud_id)

    def series_uid(self, series: Series) -> str:
        """Of a series of this result in this study."""
        return derived_uid("series", self.study_uid, self.source.cloud_id, series.role)

    def instance_uid(self, role: str) -> str:
        """Of an object of this result in this study."""
        # Corrected to another study, it is another object: archives refuse one UID in two studies, or move it.
        return derived_uid("instance", self.study_uid, self.source.cloud_id, role, str(REVISION))

    def put(self, dataset: Dataset, series: Series, role: str, number: int) -> None:
        """Set the shared modules, over what a library may have put there."""
        self._patient(dataset)
        self._study(dataset)
        self._series(dataset, series)
        dataset.Manufacturer = MANUFACTURER
        dataset.ManufacturerModelName = MANUFACTURER
        dataset.SoftwareVersions = self.source.software_version[:_LONG_STRING]
        dataset.SOPInstanceUID = self.instance_uid(role)
        dataset.InstanceNumber = number
        dataset.InstanceCreationDate, dataset.InstanceCreationTime = da(self.source.created), tm(self.source.created)
        dataset.ContentDate, dataset.ContentTime = da(self.source.created), tm(self.source.created)
        # What the library takes from the clock and from chance would make a second build another object.
        for equipment in dataset.get("ContributingEquipmentSequence", []):
            equipment.ContributionDateTime = da(self.source.created) + tm(self.source.created)
        for name in ("DimensionOrganizationSequence", "DimensionIndexSequence"):
            for dimension in dataset.get(name, []):
                dimension.DimensionOrganizationUID = derived_uid("dimensions", dataset.SOPInstanceUID)

    def image(self, series: Series, sop_class: str, role: str, number: int) -> Dataset:
        """A new image with the shared modules and the specimen."""
        dataset = self.document(series, sop_class, role, number)
        self.put_specimen(dataset)
        dataset.BurnedInAnnotation = "NO"
        dataset.PatientOrientation = None
        return dataset

    def document(self, series: Series, sop_class: str, role: str, number: int) -> Dataset:
        """A new object with the shared modules."""
        dataset = Dataset()
        dataset.SOPClassUID = sop_class
        self.put(dataset, series, role, number)
        return dataset

    def put_specimen(self, dataset: Dataset) -> None:
        """Set the specimen module."""
        context = self.context
        dataset.ContainerIdentifier = self.container_identifier
        dataset.IssuerOfTheContainerIdentifierSequence = _issuer(context.issuer_of_container_identifier)
        dataset.ContainerTypeCodeSequence = Sequence([SPECIMEN_CONTAINER])
        item = Dataset()
        item.SpecimenIdentifier = self.specimen_identifier
        item.SpecimenUID = self.specimen_uid
        item.IssuerOfTheSpecimenIdentifierSequence = _issuer(context.issuer_of_specimen_identifier)
        item.SpecimenPreparationSequence = Sequence()
        if context.specimen_description:
            item.SpecimenShortDescription = context.specimen_description
        dataset.SpecimenDescriptionSequence = Sequence([item])

    def file_meta(self, dataset: Dataset, transfer_syntax: str) -> FileMetaDataset:
        """The head of the object's file."""
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = dataset.SOPClassUID
        meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
        meta.TransferSyntaxUID = UID(transfer_syntax)
        meta.ImplementationClassUID = UID(IMPLEMENTATION_CLASS_UID)
        meta.ImplementationVersionName = (
            "SPECIMAP_" + re.sub(r"[^0-9A-Z]+", "_", self.source.software_version.upper())[:7]
        )
        return meta

    def _patient(self, dataset: Dataset) -> None:
        context = self.context
        dataset.SpecificCharacterSet = "ISO_IR 192"
        dataset.PatientName = context.patient_name
        dataset.PatientID = context.patient_id
        if context.issuer_of_patient_id:
            dataset.IssuerOfPatientID = context.issuer_of_patient_id
        dataset.PatientBirthDate = da(context.patient_birth_date)
        dataset.PatientSex = context.patient_sex

    def _study(self, dataset: Dataset) -> None:
        context = self.context
        dataset.StudyInstanceUID = self.study_uid
        # Viewers sort by it: where the order names no date, the day of the result is the best there is.
        dataset.StudyDate = da(context.study_date or self.source.created)
        dataset.StudyTime = tm(context.study_time) if context.study_date else tm(self.source.created)
        dataset.ReferringPhysicianName = context.referring_physician_name
        # As IHE's Scheduled Workflow does where the order names none; a DICOMDIR needs one.
        dataset.StudyID = context.study_id or context.requested_procedure_id or "1"
        dataset.AccessionNumber = context.accession_number
        if context.issuer_of_accession_number:
            dataset.IssuerOfAccessionNumberSequence = _issuer(context.issuer_of_accession_number)
        if context.study_description:
            dataset.StudyDescription = context.study_description

    def _series(self, dataset: Dataset, series: Series) -> None:
        context = self.context
        dataset.Modality = series.modality
        dataset.SeriesInstanceUID = self.series_uid(series)
        dataset.SeriesNumber = series.number
        dataset.SeriesDescription = series.description
        dataset.SeriesDate, dataset.SeriesTime = da(self.source.created), tm(self.source.created)
        if context.requested_procedure_id and series.modality in ("SR", "KO"):
            dataset.ReferencedRequestSequence = Sequence([self._request()])
        elif context.requested_procedure_id:
            request = Dataset()
            request.RequestedProcedureID = context.requested_procedure_id
            if context.scheduled_procedure_step_id:
                request.ScheduledProcedureStepID = context.scheduled_procedure_step_id
            dataset.RequestAttributesSequence = Sequence([request])

    def _request(self) -> Dataset:
        """The requested procedure that a document fulfils."""
        request = Dataset()
        request.StudyInstanceUID = self.study_uid
        request.ReferencedStudySequence = Sequence()
        request.AccessionNumber = self.context.accession_number
        request.PlacerOrderNumberImagingServiceRequest = ""
        request.FillerOrderNumberImagingServiceRequest = ""
        request.RequestedProcedureID = self.context.requested_procedure_id
        request.RequestedProcedureDescription = ""
        request.RequestedProcedureCodeSequence = Sequence()
        return request


def _issuer(namespace: str) -> Sequence:
    """Who gave an identifier; empty where that is not known."""
    if not namespace:
        return Sequence()
    item = Dataset()
    item.LocalNamespaceEntityID = namespace
    return Sequence([item])


def da(day: datetime.date | None) -> str:
    """A date as DICOM's DA."""
    return f"{day:%Y%m%d}" if day else ""


def tm(time: datetime.datetime | datetime.time | None) -> str:
    """A time as DICOM's TM, in whole seconds."""
    return f"{time:%H%M%S}" if time else ""


def ds(value: float) -> str:
    """A number as DICOM's DS."""
    return f"{value:.10g}"

"""The surface as Encapsulated STL, the accuracy report as Encapsulated PDF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from pydicom import Dataset
from pydicom.sequence import Sequence
from pydicom.uid import EncapsulatedPDFStorage, EncapsulatedSTLStorage, ExplicitVRLittleEndian

from specimap_core.report.document import write_document
from specimap_core.surface.mesh_files import export_mesh
from specimap_hospital.dicom.codes import MILLIMETRE
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import MESH, NO_SERIAL_NUMBER, REPORT, Header, Series, da, tm

MESH_TITLE = "Specimap surface of the specimen, mm, marker frame; not for clinical use"
REPORT_TITLE = "Specimap accuracy report; not for clinical use"


def write_mesh(header: Header, target: Path) -> Written:
    """Write the result's surface as the object ``target``.

    Raises:
        CloudDamagedError: the mesh does not read.
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    with TemporaryDirectory() as folder:
        stl = export_mesh(header.source.folder / "mesh.ply", Path(folder) / "mesh.stl", "stl").read_bytes()
    model = _encapsulated(header, MESH, EncapsulatedSTLStorage, MESH_TITLE, "model/stl", stl)
    # The standard wants one here; it is that of the markers, as of the reference images.
    model.FrameOfReferenceUID, model.PositionReferenceIndicator = header.frame_of_reference_uid, ""
    model.DeviceSerialNumber = NO_SERIAL_NUMBER
    model.MeasurementUnitsCodeSequence = Sequence([MILLIMETRE])
    model.ModelModification = "NO"
    model.ModelMirroring = "NO"
    return write_dataset(header, model, "mesh", target, ExplicitVRLittleEndian)


def write_report(header: Header, target: Path, progress: Callable[[float], None] = lambda share: None) -> Written:
    """Write the accuracy report as the object ``target``.

    Raises: as :func:`~specimap_core.report.document.write_document`.
    """
    with TemporaryDirectory() as folder:
        pdf = write_document(header.source.folder, Path(folder) / "report.pdf", "pdf", progress=progress).read_bytes()
    report = _encapsulated(header, REPORT, EncapsulatedPDFStorage, REPORT_TITLE, "application/pdf", pdf)
    report.ConversionType = "WSD"
    return write_dataset(header, report, "report", target, ExplicitVRLittleEndian)


def _encapsulated(header: Header, series: Series, sop_class: str, title: str, media_type: str, data: bytes) -> Dataset:
    document = header.document(series, sop_class, series.role, 1)
    document.AcquisitionDateTime = da(header.source.created) + tm(header.source.created)
    document.BurnedInAnnotation = "NO"
    document.DocumentTitle = title
    document.ConceptNameCodeSequence = Sequence()
    document.MIMETypeOfEncapsulatedDocument = media_type
    document.EncapsulatedDocumentLength = len(data)
    document.EncapsulatedDocument = data + b"\x00" * (len(data) % 2)
    return document

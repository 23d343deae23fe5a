"""Build the DICOM objects of a result: files and a study context in, DICOM files out; no database, no network.

It reads files that came from outside, so callers run it by :mod:`specimap_hospital.dicom.confined`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from specimap_core.errors import PhotoUnreadableError
from specimap_core.progress import within
from specimap_hospital.dicom.documents import write_mesh, write_report
from specimap_hospital.dicom.files import Written
from specimap_hospital.dicom.header import Header
from specimap_hospital.dicom.key_objects import write_key_objects
from specimap_hospital.dicom.maps import write_map
from specimap_hospital.dicom.measurements import write_measurements
from specimap_hospital.dicom.model import BandChoice, DicomObject, LeftOut, ResultSource, SegmentClass
from specimap_hospital.dicom.photos import write_photo
from specimap_hospital.dicom.pictures import read_preview, write_picture
from specimap_hospital.dicom.reference import write_reference
from specimap_hospital.dicom.result import open_result
from specimap_hospital.dicom.segmentation import write_segmentation
from specimap_infra.study_context import StudyContext

Progress = Callable[[float], None]


def build_first_set(
    context: StudyContext,
    source: ResultSource,
    out: Path,
    progress: Progress = lambda share: None,
    left_out: Callable[[LeftOut], None] = lambda photo: None,
) -> list[DicomObject]:
    """Write the first set of objects of a result into the folder ``out``, each file whole or not at all.

    These are the photos, top view and preview, the surface as STL, the accuracy figures as a structured report, the
    report as PDF, and a key object selection. The same result and context give the same objects with the same UIDs.
    A photo that cannot be read is told to ``left_out``, and the rest is written. ``progress`` hears shares of the work,
    0..1; what it raises stops the work.

    Raises:
        NotFoundError: the folder lacks a file of a result, or its report is of a version that this one cannot read.
        CloudDamagedError: cloud or mesh do not read.
        StorageFullError, OutputNotWritableError: ``out`` cannot be written.
    """
    result, header = open_result(source.folder), Header(context, source)
    photos, missing = _photos(header, out, within(progress, 0.0, 0.5), left_out)
    canvas = result.canvas
    top_view = write_picture(header, "top_view", canvas.rgb(result.cloud), canvas, out / "top-view.dcm")
    picture = canvas.preview(read_preview(source.folder / "preview.png"))
    preview = write_picture(header, "preview", picture, canvas, out / "preview.dcm")
    progress(0.6)
    mesh = write_mesh(header, out / "mesh.dcm")
    progress(0.7)
    measurements = write_measurements(header, result, top_view.dataset, missing, out / "measurements.dcm")
    report = write_report(header, out / "report.dcm", within(progress, 0.7, 0.95))
    chosen = [top_view, preview, measurements]
    key_objects = write_key_objects(header, chosen, out / "key-objects.dcm")
    progress(1.0)
    return [written.made for written in (*photos, top_view, preview, mesh, measurements, report, key_objects)]


def _photos(
    header: Header, out: Path, progress: Progress, left_out: Callable[[LeftOut], None]
) -> tuple[list[Written], list[LeftOut]]:
    """The photos by name, each in an object; those that cannot be read are told and left out."""
    found: list[Written] = []
    missing: list[LeftOut] = []
    named = sorted(header.source.photos.items())
    for number, (_, path) in enumerate(named, 1):
        try:
            found.append(write_photo(header, path, number, out / f"photo-{number:03}.dcm"))
        except PhotoUnreadableError as error:
            missing.append(LeftOut(number, error.code, error.message))
            left_out(missing[-1])
        progress(number / len(named))
    return found, missing


def build_parametric_map(
    context: StudyContext,
    source: ResultSource,
    out: Path,
    choice: BandChoice,
    progress: Progress = lambda share: None,
) -> list[DicomObject]:
    """Write bands or class probabilities of a result as a Parametric Map (float32), and the reference image that it
    lies on, whose plane is the marker frame's, not one of the patient.

    Raises:
        NotFoundError: there is no such band, layer or column.
        SettingsError: nothing or too much was chosen.
        CloudDamagedError, StorageFullError, OutputNotWritableError: as :func:`build_first_set`.
    """
    result, header = open_result(source.folder), Header(context, source)
    reference = write_reference(header, result, out / "reference.dcm")
    progress(0.3)
    found = write_map(header, result, choice, reference.dataset, out / "map.dcm")
    progress(1.0)
    return [reference.made, found.made]


def build_segmentation(
    context: StudyContext,
    source: ResultSource,
    out: Path,
    label: str,
    classes: Sequence[SegmentClass],
    progress: Progress = lambda share: None,
) -> list[DicomObject]:
    """Write a label layer of classes as a Segmentation, and the reference image that it lies on.

    Raises: as :func:`build_parametric_map`.
    """
    result, header = open_result(source.folder), Header(context, source)
    reference = write_reference(header, result, out / "reference.dcm")
    progress(0.3)
    found = write_segmentation(header, result, label, classes, reference.dataset, out / "segmentation.dcm")
    progress(1.0)
    return [reference.made, found.made]

"""The first set of a result: what is in it, for whom, and that a second build makes the same objects."""

from __future__ import annotations

import datetime
import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.uid import UID

from specimap_core.cloud import Cloud
from specimap_core.errors import CancelledError, CloudDamagedError, NotFoundError
from specimap_core.notices import Notice
from specimap_core.report.model import read_report
from specimap_core.report.wording import verdict
from specimap_core.surface.mesh_files import read_mesh_ply
from specimap_hospital.dicom.build import build_first_set
from specimap_hospital.dicom.model import BuildTask, LeftOut, SegmentClass
from specimap_infra.study_context import StudyContext
from tests.support.dicom_scene import CREATED, ORDER, PATIENT_WORDS, Built, source_of
from tests.support.document_scene import folder_of
from tests.support.photo_files import bomb, pattern, written
from tests.support.scenes import Finished

pytestmark = pytest.mark.slow
KINDS = ("top_view", "preview", "mesh", "measurements", "report", "key_objects")
PLANE = ("FrameOfReferenceUID", "ImageOrientationPatient", "ImagePositionPatient")


def texts(item: Dataset) -> list[str]:
    """All words of a report, depth first."""
    own = [item.TextValue] if "TextValue" in item else []
    return own + [text for below in item.get("ContentSequence", []) for text in texts(below)]


def numbers(item: Dataset) -> dict[str, float]:
    """Numbers by their names, of a group."""
    return {
        below.ConceptNameCodeSequence[0].CodeMeaning: float(below.MeasuredValueSequence[0].NumericValue)
        for below in item.ContentSequence
        if below.ValueType == "NUM"
    }


def groups(report: Dataset) -> dict[str, Dataset]:
    """Measurement groups by their tracking identifiers."""
    (measured,) = [c for c in report.ContentSequence if meaning(c) == "Imaging Measurements"]
    return {
        next(c.TextValue for c in g.ContentSequence if meaning(c) == "Tracking Identifier"): g
        for g in measured.ContentSequence
    }


def meaning(item: Dataset) -> str:
    return str(item.ConceptNameCodeSequence[0].CodeMeaning) if "ConceptNameCodeSequence" in item else ""


def region(group: Dataset) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The points (n, 2) of a group's region: column, row."""
    (place,) = [c for c in group.ContentSequence if c.ValueType == "SCOORD"]
    return np.array(place.GraphicData, float).reshape(-1, 2)


# ---- what is in it ------------------------------------------------------------------------------------


def test_it_holds_each_photo_and_one_object_of_each_other_kind(first_set: Built) -> None:
    assert Counter(made.kind for made in first_set.objects) == {"photo": 24, **dict.fromkeys(KINDS, 1)}
    assert len({made.sop_instance_uid for made in first_set.objects}) == 30
    assert len({made.series_uid for made in first_set.objects}) == 7
    for made in first_set.objects:
        dataset = dcmread(made.path, stop_before_pixels=True)
        assert made.study_uid == dataset.StudyInstanceUID == ORDER.study_instance_uid
        assert made.series_uid == dataset.SeriesInstanceUID
        assert (made.sop_class_uid, made.sop_instance_uid) == (dataset.SOPClassUID, dataset.SOPInstanceUID)
        assert UID(made.sop_instance_uid).is_valid
        assert made.sop_instance_uid.startswith("2.25.")


def test_every_object_is_the_orders_and_says_research(first_set: Built) -> None:
    for made in first_set.objects:
        dataset = dcmread(made.path, stop_before_pixels=True)
        assert dataset.SpecificCharacterSet == "ISO_IR 192"
        assert dataset.PatientName == ORDER.patient_name
        assert (dataset.PatientID, dataset.IssuerOfPatientID) == (ORDER.patient_id, "HOSPITAL")
        assert (dataset.PatientBirthDate, dataset.PatientSex) == ("19700102", "F")
        assert dataset.AccessionNumber == ORDER.accession_number
        assert dataset.IssuerOfAccessionNumberSequence[0].LocalNamespaceEntityID == "RIS"
        assert (dataset.StudyDate, dataset.StudyTime) == ("20261127", "093000")
        assert dataset.StudyDescription == "Specimen imaging, Größe"
        assert dataset.ReferringPhysicianName == "Roe^Richard"
        assert "research" in dataset.SeriesDescription
        requested = dataset.get("RequestAttributesSequence") or dataset.get("ReferencedRequestSequence")
        assert requested[0].RequestedProcedureID == "RP-7"


def test_every_image_has_the_specimen(first_set: Built) -> None:
    for made in [*first_set.of("photo"), *first_set.of("top_view"), *first_set.of("preview")]:
        dataset = dcmread(made.path, stop_before_pixels=True)
        assert dataset.ContainerIdentifier == "JAR-3"
        assert dataset.IssuerOfTheContainerIdentifierSequence[0].LocalNamespaceEntityID == "LAB"
        (specimen,) = dataset.SpecimenDescriptionSequence
        assert (specimen.SpecimenIdentifier, specimen.SpecimenShortDescription) == ("SP-3", "Lump, left")
        assert specimen.IssuerOfTheSpecimenIdentifierSequence[0].LocalNamespaceEntityID == "LAB"


def test_an_empty_context_leaves_the_patient_open_and_names_the_specimen(unnamed_set: Built, first_set: Built) -> None:
    studies = set()
    for made in unnamed_set.objects:
        dataset = dcmread(made.path, stop_before_pixels=True)
        assert (dataset.PatientName, dataset.PatientID, dataset.PatientBirthDate) == ("", "", "")
        assert dataset.AccessionNumber == ""
        assert dataset.StudyDate == "20261128"
        studies.add(made.study_uid)
    assert len(studies) == 1
    assert studies != {ORDER.study_instance_uid}
    image = unnamed_set.one("top_view")
    assert image.ContainerIdentifier == image.SpecimenDescriptionSequence[0].SpecimenIdentifier == "specimen-1"
    # In another study they are other objects.
    uids = [{made.sop_instance_uid for made in built.objects} for built in (unnamed_set, first_set)]
    assert not uids[0] & uids[1]


def test_top_view_and_preview_are_one_grid_in_mm_without_a_plane(first_set: Built, sample_run: Finished) -> None:
    top, preview = first_set.one("top_view"), first_set.one("preview")
    assert (top.Rows, top.Columns) == (preview.Rows, preview.Columns)
    for image in (top, preview):
        assert [float(v) for v in image.PixelSpacing] == [0.1, 0.1]
        assert not [name for name in PLANE if name in image]
    cloud = Cloud.open(sample_run.out / "cloud.zarr")
    width = float(np.ptp(cloud.xyz[:, 0]))
    assert top.Columns * 0.1 == pytest.approx(width, abs=4.0)
    # The specimen's colours, where the cloud has them.
    assert np.abs(np.median(top.pixel_array[top.pixel_array.any(2)], 0) - np.median(cloud.rgb, 0)).max() < 20


def test_the_surface_is_the_mesh_in_mm(first_set: Built, sample_run: Finished) -> None:
    surface = first_set.one("mesh")
    assert surface.MeasurementUnitsCodeSequence[0].CodeValue == "mm"
    stl = surface.EncapsulatedDocument[: surface.EncapsulatedDocumentLength]
    mesh = read_mesh_ply(sample_run.out / "mesh.ply")
    count = int.from_bytes(stl[80:84], "little")
    assert (len(stl), count) == (84 + 50 * len(mesh.triangles), len(mesh.triangles))
    record = np.dtype([("n", "<f4", 3), ("p", "<f4", (3, 3)), ("attribute", "<u2")])
    corners = np.frombuffer(stl[84:], record)["p"]
    np.testing.assert_array_equal(corners.reshape(-1, 3).min(0), mesh.vertices[np.unique(mesh.triangles)].min(0))


def test_the_report_is_its_pdf(first_set: Built) -> None:
    report = first_set.one("report")
    assert report.MIMETypeOfEncapsulatedDocument == "application/pdf"
    assert bytes(report.EncapsulatedDocument).startswith(b"%PDF-")
    assert b"%%EOF" in bytes(report.EncapsulatedDocument)[-20:]


def test_every_number_of_the_report_is_in_a_region(first_set: Built, sample_run: Finished) -> None:
    report, figures = first_set.one("measurements"), sample_run.report
    found = groups(report)
    corners = [name for name in found if "corner" in name]
    assert len(corners) == 16
    assert len(found) == 1 + 4 + 16
    whole = numbers(found["All markers"])
    assert whole["2D corner error, mean"] == pytest.approx(1000 * figures.corner_2d_mm.mean, abs=1e-3)
    assert whole["3D corner error, median"] == pytest.approx(1000 * figures.corner_3d_mm.median, abs=1e-3)
    assert whole["Stated SD of a point of the specimen, median"] == pytest.approx(
        1000 * figures.sigma_mm.median, abs=1e-3
    )
    assert whole["Marker edge, measured, mean"] == pytest.approx(figures.edge_length_mm.mean, abs=1e-4)
    assert whole["Photos used"] == len(figures.photos.used)
    left = figures.leave_one_marker_out_mm
    assert left is not None
    for marker, error in left.per_marker.items():
        assert numbers(found[f"Marker {marker}"])["Error at this marker when it is left out"] == pytest.approx(
            1000 * error, abs=1e-3
        )


def test_regions_lie_on_the_markers_of_the_top_view(first_set: Built, sample_run: Finished) -> None:
    found, top = groups(first_set.one("measurements")), first_set.one("top_view")
    grey = top.pixel_array.mean(2)
    known = json.loads((sample_run.out / "corners.json").read_text(encoding="utf-8"))
    for marker, corners in known.items():
        points = np.array([region(found[f"Marker {marker}, corner {k + 1}"])[0] for k in range(4)])
        middle = points.mean(0)
        for k in range(4):
            # The black edge lies inside the corner, the white card outside.
            inward = (middle - points[k]) / np.linalg.norm(middle - points[k])
            inside, outside = ((points[k] + step * inward).astype(int) for step in (8, -8))
            assert grey[inside[1], inside[0]] < 100 < grey[outside[1], outside[0]]
        sides = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1) * 0.1
        expected = np.linalg.norm(np.array(corners)[:, :2] - np.roll(np.array(corners)[:, :2], 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, expected, atol=1e-3)


def test_the_report_names_specimen_program_and_its_limits(first_set: Built, sample_run: Finished) -> None:
    report = first_set.one("measurements")
    said = texts(report)
    assert "SP-3" in said
    assert "JAR-3" in said
    assert any("Research use only. Not a medical device" in text for text in said)
    assert any("not of the patient" in text for text in said)
    assert any(verdict(sample_run.report).title in text for text in said)
    assert {"Specimap", "0.1.0"} <= set(said)
    assert report.VerificationFlag == "UNVERIFIED"


# ---- again, and with defects --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small_result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result without a run: a folder that a test may copy and damage."""
    from specimap_core.surface.mesh_files import write_mesh_ply
    from tests.support.scenes import bump_mesh

    folder = folder_of(tmp_path_factory.mktemp("small") / "out")
    write_mesh_ply(folder / "mesh.ply", bump_mesh(size_mm=20.0))
    return folder


@pytest.fixture
def photos(tmp_path: Path) -> dict[str, Path]:
    folder = tmp_path / "photos"
    folder.mkdir()
    return {name: written(folder / name, pattern(seed=k), "JPEG") for k, name in enumerate(("a.jpg", "b.jpg"))}


def test_a_second_build_gives_the_same_files(small_result: Path, photos: dict[str, Path], tmp_path: Path) -> None:
    source = source_of(small_result, photos)
    first, second = (build_first_set(ORDER, source, tmp_path / name) for name in ("first", "second"))
    assert [made.sop_instance_uid for made in first] == [made.sop_instance_uid for made in second]
    for one, other in zip(first, second, strict=True):
        assert one.path.read_bytes() == other.path.read_bytes(), one.kind


def test_uids_follow_from_ids_and_not_from_the_patient(
    small_result: Path, photos: dict[str, Path], tmp_path: Path
) -> None:
    source = source_of(small_result, photos)
    base = build_first_set(ORDER, source, tmp_path / "a")
    corrected = ORDER.model_copy(
        update={"patient_name": "Roe^Jane", "patient_id": "P-2", "accession_number": "B", "specimen_identifier": "X"}
    )
    again = build_first_set(corrected, source, tmp_path / "b")
    other = build_first_set(ORDER, replace(source, cloud_id="cld_02"), tmp_path / "c")
    assert [made.sop_instance_uid for made in base] == [made.sop_instance_uid for made in again]
    assert not {m.sop_instance_uid for m in base} & {m.sop_instance_uid for m in other}
    assert {m.study_uid for m in base} == {m.study_uid for m in other}


def test_two_results_of_an_acquisition_share_the_study_that_is_made(small_result: Path, tmp_path: Path) -> None:
    one = build_first_set(StudyContext(), source_of(small_result, {}), tmp_path / "a")
    other = build_first_set(StudyContext(), source_of(small_result, {}, cloud_id="cld_02"), tmp_path / "b")
    third = build_first_set(StudyContext(), source_of(small_result, {}, acquisition_id="acq_02"), tmp_path / "c")
    assert one[0].study_uid == other[0].study_uid != third[0].study_uid


def test_a_bad_photo_is_left_out_and_said(small_result: Path, photos: dict[str, Path], tmp_path: Path) -> None:
    hostile = {"aa.jpg": bomb(tmp_path / "bomb.png"), "c.jpg": tmp_path / "none.jpg", "d.jpg": tmp_path / "text.jpg"}
    hostile["d.jpg"].write_text("no photo", encoding="utf-8")
    told: list[LeftOut] = []
    made = build_first_set(
        ORDER, source_of(small_result, {**photos, **hostile}), tmp_path / "out", left_out=told.append
    )
    assert [item.path.name for item in made if item.kind == "photo"] == ["photo-001.dcm", "photo-003.dcm"]
    assert [(photo.photo, photo.code) for photo in told] == [
        (2, "photo_unreadable"),
        (4, "photo_unreadable"),
        (5, "photo_unreadable"),
    ]
    said = texts(dcmread(tmp_path / "out" / "measurements.dcm"))
    assert [text for text in said if "could not be read" in text] == [
        f"Photo {number} could not be read (photo_unreadable)." for number in (2, 4, 5)
    ]


def test_names_of_files_say_nothing_of_the_patient(small_result: Path, photos: dict[str, Path], tmp_path: Path) -> None:
    named = {"Döe Jañe P-0042.jpg": photos["a.jpg"]}
    made = build_first_set(ORDER, source_of(small_result, named), tmp_path / "out")
    names = " ".join(path.name for path in (tmp_path / "out").iterdir()) + " ".join(item.kind for item in made)
    assert not [word for word in PATIENT_WORDS if word in names]
    # Nor does the object of a photo hold the name of its file.
    assert "Jañe P-0042.jpg".encode() not in made[0].path.read_bytes()


def test_warnings_and_verdict_are_in_the_report(small_result: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    shutil.copytree(small_result, folder)
    report = read_report(folder)
    warned = report.model_copy(
        update={"warnings": [Notice("specimen_moved", "The specimen moved by 0.4 mm."), Notice("unheard_of", "New.")]}
    )
    (folder / "report.json").write_text(warned.text(), encoding="utf-8")
    build_first_set(ORDER, source_of(folder, {}), tmp_path / "dicom")
    found = dcmread(tmp_path / "dicom" / "measurements.dcm")
    said = texts(found)
    assert any(text.startswith("specimen_moved: The specimen moved by 0.4 mm. Check the preview") for text in said)
    assert any(text.startswith("unheard_of: New.") for text in said)
    (words,) = [c for c in found.ContentSequence if meaning(c) == "Qualitative Evaluations"]
    (code,) = [c for c in words.ContentSequence if c.ValueType == "CODE"]
    assert code.ConceptCodeSequence[0].CodeMeaning == "Look before use"


def test_a_report_of_an_earlier_version_makes_objects_too(tmp_path: Path) -> None:
    from specimap_core.surface.mesh_files import write_mesh_ply
    from tests.support.scenes import bump_mesh

    folder = folder_of(tmp_path / "old", old=True)
    write_mesh_ply(folder / "mesh.ply", bump_mesh(size_mm=20.0))
    made = build_first_set(ORDER, source_of(folder, {}), tmp_path / "out")
    assert {item.kind for item in made} == set(KINDS)
    assert "All markers" in groups(dcmread(tmp_path / "out" / "measurements.dcm"))


@pytest.mark.parametrize("name", ["report.json", "corners.json", "mesh.ply", "preview.png", "cloud.zarr"])
def test_a_missing_file_is_a_clear_refusal(small_result: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "out"
    shutil.copytree(small_result, folder)
    if (folder / name).is_dir():
        shutil.rmtree(folder / name)
    else:
        (folder / name).unlink()
    with pytest.raises(NotFoundError) as refusal:
        build_first_set(ORDER, source_of(folder, {}), tmp_path / "dicom")
    assert refusal.value.advice


@pytest.mark.parametrize("name", ["report.json", "corners.json", "mesh.ply", "preview.png"])
def test_a_damaged_file_is_a_clear_refusal(small_result: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "out"
    shutil.copytree(small_result, folder)
    (folder / name).write_bytes((folder / name).read_bytes()[:40])
    with pytest.raises((NotFoundError, CloudDamagedError)) as refusal:
        build_first_set(ORDER, source_of(folder, {}), tmp_path / "dicom")
    assert refusal.value.advice


def test_a_stop_leaves_whole_files_alone(small_result: Path, photos: dict[str, Path], tmp_path: Path) -> None:
    def stop(share: float) -> None:
        if share >= 0.5:
            raise CancelledError("stopped")

    with pytest.raises(CancelledError):
        build_first_set(ORDER, source_of(small_result, photos), tmp_path / "out", stop)
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left == ["photo-001.dcm", "photo-002.dcm"]
    for name in left:
        assert dcmread(tmp_path / "out" / name).PixelData


def test_times_are_the_results_own(small_result: Path, tmp_path: Path) -> None:
    late = CREATED.replace(tzinfo=datetime.UTC, microsecond=250)
    build_first_set(StudyContext(), source_of(small_result, {}, created=late), tmp_path / "out")
    found = dcmread(tmp_path / "out" / "top-view.dcm")
    assert (found.ContentDate, found.ContentTime, found.StudyTime) == ("20261128", "140506", "140506")


def test_a_task_survives_its_way_as_json() -> None:
    task = BuildTask("segmentation", label="a", classes=(SegmentClass(1, "Tumör", "#ff0000"),), archive="x.zip")
    assert BuildTask.from_dict(json.loads(json.dumps(task.as_dict()))) == task

"""Other people's programs judge the objects: dicom3tools, dcmtk, PixelMed."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from pydicom import dcmread

from tests.support.dicom_scene import PATIENT_WORDS, Built, dciodvfy, pixelmed, program, said_by

KINDS = ("photo", "top_view", "preview", "mesh", "measurements", "report", "key_objects")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_dciodvfy_finds_no_error(first_set: Built, unnamed_set: Built, kind: str) -> None:
    for built in (first_set, unnamed_set):
        assert built.of(kind)
        for made in built.of(kind):
            assert dciodvfy(made.path) == []


@pytest.mark.slow
def test_the_validator_sees_errors(first_set: Built, tmp_path: Path) -> None:
    damaged = first_set.one("top_view")
    del damaged.ConversionType
    damaged.save_as(tmp_path / "damaged.dcm")
    assert dciodvfy(tmp_path / "damaged.dcm") != []


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_dcmtk_reads_each_object_in_its_characters(first_set: Built, kind: str) -> None:
    said = said_by([program("dcmdump"), "--convert-to-utf8", str(first_set.of(kind)[0].path)])
    assert "PatientName" in said
    assert "Döe^Jañe^Łucja" in said
    assert not [line for line in said.splitlines() if line.startswith(("E:", "F:"))]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["measurements", "key_objects"])
def test_dcmtk_reads_the_documents(first_set: Built, kind: str) -> None:
    said = said_by([program("dsrdump"), "--print-all-codes", str(first_set.of(kind)[0].path)])
    assert not [line for line in said.splitlines() if line.startswith(("E:", "F:"))]
    if kind == "measurements":
        assert "Imaging Measurement Report" in said
        assert said.count("POINT") == 16
        assert "Research use only" in said


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["measurements", "key_objects"])
def test_pixelmeds_validator_has_nothing_to_say(first_set: Built, kind: str) -> None:
    assert pixelmed(first_set.of(kind)[0].path) == []


@pytest.mark.slow
def test_the_zip_holds_a_dicomdir_that_others_read(first_set: Built, unnamed_set: Built, tmp_path: Path) -> None:
    for built, patient in ((first_set, "P-0042"), (unnamed_set, "UNKNOWN")):
        folder = tmp_path / patient
        with zipfile.ZipFile(built.archive) as archive:
            names = archive.namelist()
            archive.extractall(folder)
        assert not [word for word in PATIENT_WORDS if word in " ".join(names)]
        said = said_by([program("dcmdump"), str(folder / "DICOMDIR")])
        assert said.count('"Directory Record" IMAGE') == 26
        for record in ("PATIENT", "STUDY", "SR DOCUMENT", "KEY OBJECT DOC"):
            assert said.count(f'"Directory Record" {record}') == 1
        assert said.count('"Directory Record" ENCAP DOC') == 2
        assert f"[{patient}]" in said
        stored = {dcmread(path).SOPInstanceUID for path in folder.rglob("PT*/ST*/SE*/*")}
        assert stored == {made.sop_instance_uid for made in built.objects}


@pytest.mark.slow
def test_the_same_objects_make_the_same_zip(first_set: Built, tmp_path: Path) -> None:
    from specimap_hospital.dicom.archive import write_zip

    again = write_zip(first_set.objects, tmp_path / "again.zip")
    with zipfile.ZipFile(again) as one, zipfile.ZipFile(first_set.archive) as other:
        assert one.namelist() == other.namelist()
        for name in one.namelist():
            assert one.read(name) == other.read(name), name

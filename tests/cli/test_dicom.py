"""``specimap dicom``: a run as DICOM objects, whole or not at all; a bad context is refused without its values."""

from __future__ import annotations

import json
import zipfile
from collections import Counter
from pathlib import Path

import pytest
from pydicom import dcmread

from tests.support.scenes import Finished, OnDisk, specimap

CONTEXT = {"patient_name": "Döe^Jane", "patient_id": "P-1", "accession_number": "A-1", "study_date": "2026-11-27"}


@pytest.fixture
def context(tmp_path: Path) -> Path:
    path = tmp_path / "context.json"
    path.write_text(json.dumps(CONTEXT), encoding="utf-8")
    return path


@pytest.mark.slow
def test_it_writes_objects_and_a_zip(finished: Finished, small: OnDisk, context: Path, tmp_path: Path) -> None:
    out = tmp_path / "dicom"
    given = ("dicom", finished.out, "--out", out, "--context", context, "--photos", small.photos, "--specimen", "S-9")
    answer = specimap(*given, "--zip", "--json")
    assert answer.status == 0, answer
    *progress, last = answer.events
    assert progress
    assert {event["event"] for event in progress} == {"progress"}
    assert last["event"] == "dicom"
    objects = last["objects"]
    assert isinstance(objects, list)
    kinds = Counter(item["kind"] for item in objects)
    assert kinds["photo"] == len(list(small.photos.iterdir()))
    assert set(kinds) == {"photo", "top_view", "preview", "mesh", "measurements", "report", "key_objects"}
    for item in objects:
        dataset = dcmread(item["path"])
        assert dataset.PatientName == "Döe^Jane"
        assert dataset.SOPInstanceUID == item["sop_instance_uid"]
    assert dcmread(out / "top-view.dcm").ContainerIdentifier == "S-9"
    with zipfile.ZipFile(out / "dicom.zip") as archive:
        assert "DICOMDIR" in archive.namelist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["context.json", "dicom"]

    again = specimap(*given, "--json")
    assert again.events[-1]["objects"] == objects
    assert not (out / "dicom.zip").exists(), "what an earlier call wrote does not stay beside the new objects"


@pytest.mark.slow
def test_photos_and_context_may_be_missing(finished: Finished, tmp_path: Path) -> None:
    answer = specimap("dicom", finished.out, "--out", tmp_path / "dicom")
    assert answer.status == 0, answer
    assert "Wrote 6 objects" in answer.out
    assert dcmread(tmp_path / "dicom" / "preview.dcm").PatientID == ""


@pytest.mark.slow
def test_a_photo_that_is_left_out_is_said(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    first = min(small.photos.iterdir())
    (photos / "a.jpg").write_bytes(first.read_bytes())
    (photos / "b.jpg").write_bytes(first.read_bytes()[:3000])
    answer = specimap("dicom", finished.out, "--out", tmp_path / "dicom", "--photos", photos)
    assert answer.status == 0, answer
    assert "Wrote 7 objects" in answer.out
    assert "Photo 2 is left out: " in answer.out


@pytest.mark.parametrize(
    ("content", "fields"),
    [
        ('{"patient_name": "Secret\\\\Name"}', ["patient_name"]),
        ('{"patient_birth_date": "SecretName"}', ["patient_birth_date"]),
        ('{"SecretName": 1}', []),
        ("SecretName", []),
        ("[]", []),
    ],
)
def test_a_bad_context_is_refused_without_its_values(
    finished: Finished, tmp_path: Path, content: str, fields: list[str]
) -> None:
    path = tmp_path / "context.json"
    path.write_text(content, encoding="utf-8")
    answer = specimap("dicom", finished.out, "--out", tmp_path / "dicom", "--context", path, "--json")
    assert answer.status == 2
    assert answer.refusal["code"] == "setting_invalid"
    assert answer.refusal["advice"]
    details = answer.refusal["details"]
    assert isinstance(details, dict)
    assert details["fields"] == fields
    assert "Secret" not in answer.out + answer.err
    assert not (tmp_path / "dicom").exists()


def test_other_files_are_not_touched(finished: Finished, tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("mine", encoding="utf-8")
    answer = specimap("dicom", finished.out, "--out", tmp_path, "--json")
    assert (answer.status, answer.refusal["code"]) == (2, "output_exists")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    answer = specimap("dicom", tmp_path, "--out", tmp_path / "dicom", "--json")
    assert (answer.status, answer.refusal["code"]) == (2, "not_found")
    missing = specimap("dicom", tmp_path, "--out", tmp_path / "dicom", "--context", tmp_path / "none.json", "--json")
    assert (missing.status, missing.refusal["code"]) == (2, "not_found")
    assert list(tmp_path.iterdir()) == []

"""DICOM objects of the sample, made once for all processes, and the programs of others that judge them."""

from __future__ import annotations

import datetime
import json
import os
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from pydicom import Dataset, dcmread

from specimap_hospital.dicom.confined import build_confined
from specimap_hospital.dicom.model import BuildTask, DicomObject, ResultSource
from specimap_infra.study_context import StudyContext
from tests.support.places import SAMPLES
from tests.support.scenes import Finished, shared_run
from tests.support.shared_folders import SharedFolders

CREATED = datetime.datetime(2026, 11, 28, 14, 5, 6)
ORDER = StudyContext(
    study_instance_uid="1.2.826.0.1.3680043.8.498.77",
    accession_number="A-0042",
    issuer_of_accession_number="RIS",
    patient_id="P-0042",
    issuer_of_patient_id="HOSPITAL",
    patient_name="Döe^Jañe^Łucja",
    patient_birth_date=datetime.date(1970, 1, 2),
    patient_sex="F",
    referring_physician_name="Roe^Richard",
    study_description="Specimen imaging, Größe",
    study_date=datetime.date(2026, 11, 27),
    study_time=datetime.time(9, 30),
    requested_procedure_id="RP-7",
    scheduled_procedure_step_id="SPS-7",
    container_identifier="JAR-3",
    issuer_of_container_identifier="LAB",
    specimen_identifier="SP-3",
    issuer_of_specimen_identifier="LAB",
    specimen_description="Lump, left",
)
PATIENT_WORDS = ("Döe", "Jañe", "Łucja", "Doe", "P-0042", "A-0042", "Roe", "19700102")
"""What may stand in no name of a file and in no log."""


def source_of(folder: Path, photos: Mapping[str, Path] | None = None, **changes: Any) -> ResultSource:
    """A result's folder as a source, with the sample's photos unless others are given."""
    if photos is None:
        photos = {path.name: path for path in sorted((SAMPLES / "rgb").glob("*.jpg"))}
    given: dict[str, Any] = {
        "folder": folder,
        "photos": photos,
        "acquisition_id": "acq_01",
        "specimen_id": "specimen-1",
        "cloud_id": "cld_01",
        "job_id": "job_01",
        "created": CREATED,
        "software_version": "0.1.0",
    }
    return ResultSource(**{**given, **changes})


@dataclass(frozen=True)
class Built:
    """Objects in a folder; ``archive``: their ZIP."""

    objects: list[DicomObject]
    source: ResultSource
    context: StudyContext
    archive: Path

    def of(self, kind: str) -> list[DicomObject]:
        """The objects of a kind."""
        return [made for made in self.objects if made.kind == kind]

    def one(self, kind: str) -> Dataset:
        """The only, or first, object of a kind."""
        return dcmread(self.of(kind)[0].path)


def shared_set(shared_folders: SharedFolders, run: Finished, context: StudyContext) -> Built:
    """The first set of a run, built confined, once for all processes; nobody changes it."""
    source = source_of(run.out)

    def make(folder: Path) -> None:
        made = build_confined(BuildTask(archive="all.zip"), context, source, folder / "objects")
        listed = [{**item.as_dict(), "path": item.path.name} for item in made]
        (folder / "objects.json").write_text(json.dumps(listed), encoding="utf-8")

    folder = shared_folders.made("dicom", (run.out, context), make)
    listed = json.loads((folder / "objects.json").read_text(encoding="utf-8"))
    objects = [DicomObject.from_dict({**item, "path": str(folder / "objects" / item["path"])}) for item in listed]
    return Built(objects, source, context, folder / "objects" / "all.zip")


@pytest.fixture(scope="session")
def sample_run(shared_folders: SharedFolders) -> Finished:
    """One whole run on the sample; copy it before changing it."""
    return shared_run(shared_folders, SAMPLES)


@pytest.fixture(scope="session")
def first_set(shared_folders: SharedFolders, sample_run: Finished) -> Built:
    """The first set of the sample, of an order whose names are not ASCII."""
    return shared_set(shared_folders, sample_run, ORDER)


@pytest.fixture(scope="session")
def unnamed_set(shared_folders: SharedFolders, sample_run: Finished) -> Built:
    """The first set of the sample, of an empty study context."""
    return shared_set(shared_folders, sample_run, StudyContext())


# ---- programs of others -------------------------------------------------------------------------------

_PACKAGES = {
    "dciodvfy": "dicom3tools",
    "dcmdump": "dcmtk",
    "dsrdump": "dcmtk",
    "storescu": "dcmtk",
    "findscu": "dcmtk",
    "java": "pixelmed-apps default-jre-headless",
}
_PIXELMED = Path("/usr/share/java/pixelmed.jar")


def program(name: str) -> str:
    """The path of a program; skips where it is not installed, and says how to get it."""
    found = shutil.which(name)
    if found is None or (name == "java" and not _PIXELMED.is_file()):
        pytest.skip(f"there is no {name}: apt-get install {_PACKAGES[name]}")
    return found


def said_by(command: list[str], seconds: float = 120) -> str:
    """What a program says, on either output; fails where its exit status is not 0."""
    done = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=seconds,
        env={**os.environ, "LC_ALL": "C.UTF-8"},
    )
    said = done.stdout.decode("utf-8", "replace")
    assert done.returncode == 0, f"{command[0]}: {said[-2000:]}"
    return said


def dciodvfy(path: Path) -> list[str]:
    """The errors that dicom3tools' validator finds."""
    done = subprocess.run([program("dciodvfy"), str(path)], capture_output=True, timeout=120)
    lines = (done.stdout + done.stderr).decode("utf-8", "replace").splitlines()
    assert lines, "it names the object at least"
    return [line for line in lines if line.startswith(("Error", "Abort")) or "Segmentation fault" in line]


def pixelmed(path: Path) -> list[str]:
    """What PixelMed's validator of structured reports says against one. It takes a minute."""
    # Its templates are more than Java's limits on expressions allow.
    limits = [f"-Djdk.xml.{name}=0" for name in ("xpathExprGrpLimit", "xpathExprOpLimit", "xpathTotalOpLimit")]
    said = said_by(
        [program("java"), *limits, "-cp", str(_PIXELMED), "com.pixelmed.validate.DicomSRValidator", str(path)], 600
    )
    assert "IOD validation complete" in said, said
    return [line for line in said.splitlines() if line.startswith(("Error", "Warning"))]

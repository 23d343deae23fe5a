"""``specimap dicom``: a finished run as DICOM objects, for people without a service."""

from __future__ import annotations

import hashlib
import os
import tempfile
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from specimap_cli.errors import Debug, reported_errors, stoppable
from specimap_cli.progress import Listener, json_listener, progress_listener
from specimap_core.errors import NotFoundError, OutputExistsError, SettingsError

if TYPE_CHECKING:
    from specimap_hospital.dicom.model import DicomObject, LeftOut, ResultSource
    from specimap_infra.study_context import StudyContext

ARCHIVE = "dicom.zip"
UNNAMED_SPECIMEN = "SPECIMEN"
"""Objects must name one."""


def dicom(
    result: Annotated[Path, typer.Argument(help="Folder of a run.")],
    out: Annotated[Path, typer.Option(help="Folder for the objects; those of an earlier call are replaced.")],
    context: Annotated[
        Path | None, typer.Option(help="JSON file with order, patient and specimen; docs/dicom.md lists its fields.")
    ] = None,
    photos: Annotated[
        Path | None, typer.Option(help="Folder of the run's photos; without it the objects hold no photos.")
    ] = None,
    specimen: Annotated[str, typer.Option(help="Id of the specimen where the context names none.")] = UNNAMED_SPECIMEN,
    archive: Annotated[bool, typer.Option("--zip", help=f"Also write {ARCHIVE}, with a DICOMDIR.")] = False,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")] = False,
    debug: Debug = False,
) -> None:
    """Write a run as DICOM objects: photos, top view, spectral preview, surface, accuracy figures, report."""
    listener: Listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_hospital.dicom.confined import build_confined
        from specimap_hospital.dicom.model import BuildTask

        study, source = _read_context(context), _source(result.absolute(), photos, specimen)
        missing: list[LeftOut] = []
        _check_out(out)
        # Beside the target, so that the objects appear together or not at all.
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", suffix=".tmp", dir=out.parent) as folder, listener:
            made = build_confined(
                BuildTask(archive=ARCHIVE if archive else None),
                study,
                source,
                Path(folder) / "out",
                progress=lambda share: listener.progress("dicom", share),
                cancelled=stop_asked,
                left_out=missing.append,
            )
            from specimap_core.atomic import disk_errors, replace

            with disk_errors(out):
                replace(Path(folder) / "out", out)
        _say(listener, out, made, missing)


def _say(listener: Listener, out: Path, made: list[DicomObject], missing: list[LeftOut]) -> None:
    sentence = f"Wrote {len(made)} objects to {out}"
    for photo in missing:
        sentence += f"\nPhoto {photo.photo} is left out: {photo.message}"
    listener.kept(
        "dicom",
        sentence,
        out=str(out),
        objects=[{**item.as_dict(), "path": str(out / item.path.name)} for item in made],
        left_out=[vars(photo) for photo in missing],
    )


def _read_context(path: Path | None) -> StudyContext:
    """The study context of a JSON file; an empty one without a file.

    Raises:
        NotFoundError: there is no such file.
        SettingsError: it is no study context; its fields are named, and no value, since they are a patient's.
    """
    from pydantic import ValidationError

    from specimap_infra.study_context import StudyContext

    if path is None:
        return StudyContext()
    try:
        return StudyContext.model_validate_json(path.read_bytes())
    except OSError as error:
        raise NotFoundError(f"The study context {path} cannot be read.", advice="Name a JSON file.") from error
    except ValidationError as error:
        known = {str(item["loc"][0]) for item in error.errors(include_input=False) if item["loc"]}
        fields = sorted(known & StudyContext.model_fields.keys())
        raise SettingsError(
            f"The study context is not valid: {', '.join(fields) or 'it is no JSON object of its fields'}.",
            advice="docs/dicom.md lists the fields and what they may hold.",
            setting="context",
            fields=fields,
        ) from None


def _source(folder: Path, photos: Path | None, specimen: str) -> ResultSource:
    """A run's folder as a source; its ids follow from its content, so that a second call makes the same objects."""
    from specimap_core.json_text import json_text
    from specimap_core.photos.folder import photo_paths
    from specimap_core.report.model import read_report
    from specimap_hospital.dicom.model import ResultSource

    report = read_report(folder)
    result_id = _digest((folder / "report.json").read_bytes())
    inputs = json_text(report.inputs, sort_keys=True).encode()
    return ResultSource(
        folder=folder,
        photos={path.name: path.absolute() for path in photo_paths(photos)} if photos else {},
        acquisition_id=_digest(inputs) if report.inputs else result_id,
        specimen_id=specimen.strip()[:64] or UNNAMED_SPECIMEN,
        cloud_id=result_id,
        job_id=result_id,
        created=datetime.fromisoformat(report.created),
        software_version=report.specimap_version,
    )


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _check_out(out: Path) -> None:
    """Refuse a folder that holds anything but objects of an earlier call.

    Raises:
        OutputExistsError: it does, or it is a file.
        NotFoundError: it may not be read.
    """
    try:
        names = os.listdir(out)
    except FileNotFoundError:
        return
    except NotADirectoryError:
        raise OutputExistsError(f"{out} is a file.", advice="Name a folder for the objects.") from None
    except OSError as error:
        raise NotFoundError(f"{out} cannot be read.", advice="Name another folder.") from error
    if any(not name.endswith(".dcm") and name != ARCHIVE for name in names):
        raise OutputExistsError(
            f"{out} holds other files than DICOM objects.",
            advice="Name a new or empty folder, or one of an earlier call.",
        )

"""Inputs and outputs of a run; the results appear together, once all are written."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from specimap_core.atomic import disk_errors, remove, remove_leftovers, replace
from specimap_core.errors import OutputExistsError, OutputNotWritableError
from specimap_core.pipeline.artefact_store import Store

MARK = ".specimap"
"""A file in every output folder; a folder with other files and without it is not written to."""


@dataclass(frozen=True)
class Inputs:
    """``photos``: a folder; ``cube``: a file; ``white`` and ``dark``: reference frames, where there are some."""

    photos: Path
    cube: Path
    white: Path | None = None
    dark: Path | None = None


@dataclass(frozen=True)
class Outputs:
    """Where a run's results lie."""

    folder: Path

    @property
    def cloud(self) -> Path:
        """The spectral cloud."""
        return self.folder / "cloud.zarr"

    @property
    def mesh(self) -> Path:
        """The surface."""
        return self.folder / "mesh.ply"

    @property
    def report(self) -> Path:
        """The report; written last, so that its presence says that the run is whole."""
        return self.folder / "report.json"

    @property
    def corners(self) -> Path:
        """The markers' corners."""
        return self.folder / "corners.json"

    @property
    def cameras(self) -> Path:
        """The cameras of the photos and of the cube; not there in results of versions that kept none."""
        return self.folder / "cameras.json"

    @property
    def preview(self) -> Path:
        """Principal components on the top view."""
        return self.folder / "preview.png"

    @property
    def sheet(self) -> Path:
        """Small tiles of the used photos; not there where stage 1 was kept from a version that made none."""
        return self.folder / "photos.jpg"

    @property
    def store(self) -> Store:
        """The stages' artefacts."""
        return Store(self.folder / "stages")


def prepare_folder(folder: Path) -> None:
    """Make the output folder, or accept one of an earlier run.

    Raises:
        OutputExistsError: it holds files that Specimap did not write.
        OutputNotWritableError: it cannot be made or written.
    """
    if not _is_utf8(folder):
        raise OutputNotWritableError(
            f"The path {os.fsencode(folder.absolute()).decode('utf-8', 'replace')} is not UTF-8, in which the results "
            "cannot be written.",
            advice="Choose a folder whose whole path is UTF-8.",
        )
    with disk_errors(folder):
        if folder.exists() and not folder.is_dir():
            raise OutputExistsError(f"{folder} is a file.", advice="Name a folder for the results.")
        folder.mkdir(parents=True, exist_ok=True)
        mark = folder / MARK
        if not mark.exists() and any(folder.iterdir()):
            raise OutputExistsError(
                f"{folder} holds files that Specimap did not write.",
                advice="Name a new or empty folder, or one of an earlier run.",
            )
        mark.write_text("An output folder of Specimap.\n", encoding="utf-8")
        for place in (folder, folder / "stages"):
            remove_leftovers(place)


def _is_utf8(folder: Path) -> bool:
    try:
        os.fsencode(folder.absolute()).decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


@contextmanager
def staged(outputs: Outputs) -> Iterator[Outputs]:
    """A folder aside to write all results to; they replace those in ``outputs`` when the block succeeds.

    The report goes first and comes last, so that a report always stands with the results that it describes.

    Raises:
        StorageFullError, OutputNotWritableError: nothing has been replaced then.
    """
    aside = Outputs(outputs.folder / f".results.{uuid.uuid4().hex[:8]}.tmp")
    with disk_errors(outputs.folder):
        try:
            aside.folder.mkdir()
            yield aside
            outputs.report.unlink(missing_ok=True)
            outputs.sheet.unlink(missing_ok=True)
            if aside.sheet.exists():
                replace(aside.sheet, outputs.sheet)
            for name in ("cloud", "mesh", "corners", "cameras", "preview", "report"):
                replace(getattr(aside, name), getattr(outputs, name))
        finally:
            remove(aside.folder)

"""The accuracy report of a run as a document to read and print: HTML and PDF.

Drawn from what a run left in its folder alone: report.json, cloud.zarr, and photos.jpg and preview.png where they are.
Spectra are not read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from specimap_core.report.compose import compose
from specimap_core.report.html import write_page
from specimap_core.report.inputs import read_material
from specimap_core.report.pdf import write_pdf

DocumentFormat = Literal["html", "pdf"]


def write_document(
    folder: Path,
    target: Path,
    format: DocumentFormat,
    *,
    truth: Path | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Write the report on the run in ``folder`` to ``target``, whole or not at all; the path written.

    ``truth``: a phantom's ``truth.npz`` or its folder; adds the errors against it. ``progress`` hears shares of the
    work; what it raises stops the work.

    Raises:
        NotFoundError: there is no report, none that this version reads, or no cloud or truth.
        SettingsError: the truth is of another acquisition.
        BackendUnavailableError: a library is not installed.
        CloudDamagedError, StorageFullError, OutputNotWritableError: as reading and writing raise them.
    """
    document = compose(read_material(folder, truth))
    return write_page(document, target, progress) if format == "html" else write_pdf(document, target, progress)


__all__ = ["DocumentFormat", "write_document"]

"""A spectral cloud as a file of another program: PLY, LAS, NPZ, ENVI, CSV; and the report on it: HTML, PDF.

Every export is streamed in bounded memory and appears whole or not at all.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from specimap_core.cloud import Cloud
from specimap_core.errors import SettingsError
from specimap_core.export.envi import write_envi
from specimap_core.export.las import write_las
from specimap_core.export.npz import write_npz
from specimap_core.export.ply import write_ply
from specimap_core.export.table import write_csv

ExportFormat = Literal["ply", "las", "npz", "envi", "csv", "html", "pdf"]

_Exporter = Callable[[Cloud, Path, float], Path]

EXPORTERS: dict[str, _Exporter] = {
    "ply": lambda cloud, target, _: write_ply(cloud, target),
    "las": lambda cloud, target, _: write_las(cloud, target),
    "npz": lambda cloud, target, _: write_npz(cloud, target),
    "envi": lambda cloud, target, grid_mm: write_envi(cloud, target, grid_mm=grid_mm),
    "csv": lambda cloud, target, _: write_csv(cloud, target),
    "html": lambda cloud, target, _: _write_report(cloud, target, "html"),
    "pdf": lambda cloud, target, _: _write_report(cloud, target, "pdf"),
}
"""Another format is one function here."""


def export_cloud(cloud: Cloud, target: Path, format: ExportFormat, *, grid_mm: float = 0.5) -> Path:
    """Write the cloud to ``target``, replacing it; the path written (ENVI: the header's).

    Spectra are in ``npz``, ``csv`` and, resampled on a top view of ``grid_mm``, ``envi``; ``ply`` and ``las``
    hold the geometry, in the cloud's order, so that the n-th point's spectrum is the cloud's n-th. ``html`` and
    ``pdf`` are the accuracy report, drawn from the files next to the cloud.

    Raises SettingsError for an unknown format or a grid that is not positive or far too fine,
    BackendUnavailableError where a format's library is not installed, NotFoundError where no report lies next to
    the cloud, StorageFullError, OutputNotWritableError, CloudDamagedError.
    """
    exporter = EXPORTERS.get(format)
    if exporter is None:
        raise SettingsError(
            f"There is no export format {format!r}.",
            advice=f"Choose one of {', '.join(EXPORTERS)}.",
            setting="format",
            choices=list(EXPORTERS),
        )
    return exporter(cloud, target, grid_mm)


def _write_report(cloud: Cloud, target: Path, format: Literal["html", "pdf"]) -> Path:
    # Imported late: the other formats need no plotting library.
    from specimap_core.report.document import write_document

    return write_document(cloud.path.parent, target, format)

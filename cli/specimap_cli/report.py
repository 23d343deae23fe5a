"""``specimap report``: the accuracy report of a run as a document."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from specimap_cli.errors import Debug, reported_errors
from specimap_cli.progress import json_listener, progress_listener
from specimap_core.json_text import json_text


class DocumentFormat(StrEnum):
    """Formats of the report."""

    html = "html"
    pdf = "pdf"


def report(
    out: Annotated[Path, typer.Argument(help="Folder of a run.")],
    format: Annotated[DocumentFormat, typer.Option(help="A page for a browser, or a PDF.")] = DocumentFormat.html,
    target: Annotated[Path | None, typer.Option(help="Where to; by default report.html or report.pdf in OUT.")] = None,
    truth: Annotated[
        Path | None, typer.Option(help="A phantom's truth.npz, or its folder: adds the errors against it.")
    ] = None,
    json_events: Annotated[bool, typer.Option("--json", help="Answer in one JSON line.")] = False,
    debug: Debug = False,
) -> None:
    """Write the accuracy report of a run: verdict, figures, photos with their corners, maps, settings."""
    with reported_errors(json_listener() if json_events else progress_listener(), debug):
        from specimap_core.report.document import write_document

        written = write_document(out, target or out / f"report.{format.value}", format.value, truth=truth)
        if json_events:
            sys.stdout.write(json_text({"event": "reported", "path": str(written)}) + "\n")
        else:
            typer.echo(f"Wrote {written}")

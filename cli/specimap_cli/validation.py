"""``specimap study subsampling`` and ``specimap validate``: the figures measured anew."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from specimap_cli import run_options
from specimap_cli.errors import Debug, reported_errors, stoppable
from specimap_cli.progress import Listener, json_listener, progress_listener
from specimap_core.errors import SettingsError
from specimap_core.json_text import json_text
from specimap_core.pipeline.options import DEFAULTS, RunOptions

if TYPE_CHECKING:
    from specimap_validation.tables import Table

WIDTH = 160
"""Columns where the output is not a terminal."""

study_app = typer.Typer(no_args_is_help=True, help="Studies of how the method behaves.")

Json = Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")]


@study_app.callback()
def _study() -> None:
    """Studies of how the method behaves."""


@study_app.command()
def subsampling(
    acquisition: Annotated[Path, typer.Argument(help="Folder with rgb/ or photos/, hsi/*.hdr, truth.npz if any.")],
    out: Annotated[Path, typer.Option(help="Folder for the study; an interrupted one goes on.")],
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Random choices of the photos for each share.")] = 3,
    shares: Annotated[str, typer.Option(help="Shares of the photos, percent.")] = "100,90,80,70,60,50",
    edge_mm: run_options.EdgeMm = DEFAULTS.edge_mm,
    dictionary: run_options.Dictionary = DEFAULTS.dictionary,
    json_events: Json = False,
    debug: Debug = False,
) -> None:
    """Run on 100 % to 50 % of the photos: subsampling.json, subsampling.html, figures of 2D and 3D error."""
    listener: Listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_core.pipeline.settings import settings_from
        from specimap_core.reconstruct.dense.device import dense_device
        from specimap_validation.capture import find_capture
        from specimap_validation.pages import check_drawing, publish_study
        from specimap_validation.subsampling import Row, study_subsampling
        from specimap_validation.tables import study_table

        wanted = _numbers(shares, "shares")
        settings = settings_from(RunOptions(edge_mm=edge_mm, dictionary=dictionary), dense_device(os.environ))
        capture = find_capture(acquisition)
        check_drawing()

        def on_row(row: Row) -> None:
            if json_events:
                _say(event="run", **row.model_dump(mode="json"))

        with listener:
            study = study_subsampling(
                capture,
                out,
                settings,
                shares=wanted,
                seeds=seeds,
                progress=lambda share: listener.progress("study", share),
                on_row=on_row,
                cancelled=stop_asked,
            )
            written = publish_study(study, out)
        _finished(json_events, out, study.model_dump(mode="json"), [study_table(study.rows)], written)


def validate(
    out: Annotated[Path, typer.Option(help="Folder for the validation; an interrupted one goes on.")],
    seeds: Annotated[str, typer.Option(help="Seeds of the phantoms; with --quick the first alone.")] = "1,2,3",
    quick: Annotated[bool, typer.Option("--quick", help="Four defects, one seed, small phantoms.")] = False,
    acquisition: Annotated[
        list[Path] | None, typer.Option(help="An acquisition with truth.npz, judged too; may be repeated.")
    ] = None,
    update_docs: Annotated[
        Path | None, typer.Option(help="Page of markdown whose place <!-- validation --> takes the tables.")
    ] = None,
    json_events: Json = False,
    debug: Debug = False,
) -> None:
    """Judge both registrations and both adjustments against truth, on phantoms with one defect each."""
    listener: Listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_validation import validation as v
        from specimap_validation.cases import cases
        from specimap_validation.page_marks import check_marks, put
        from specimap_validation.pages import check_drawing, markdown, publish_validation
        from specimap_validation.tables import validation_tables

        chosen = _numbers(seeds, "seeds")
        found = cases(chosen[:1] if quick else chosen, tuple(acquisition or ()), quick=quick)
        check_drawing()
        if update_docs is not None:
            check_marks(update_docs, v.MARK)

        def on_row(row: v.Row) -> None:
            if json_events:
                _say(event="run", **row.model_dump(mode="json"))

        with listener:
            validation = v.validate(
                found,
                out,
                quick=quick,
                progress=lambda share: listener.progress("validate", share),
                on_row=on_row,
                cancelled=stop_asked,
            )
            written = publish_validation(validation, out)
        if update_docs is not None:
            put(update_docs, v.MARK, markdown(validation))
            written.append(update_docs)
        _finished(json_events, out, validation.model_dump(mode="json"), validation_tables(validation), written)


def _numbers(text: str, setting: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise SettingsError(
            f"{setting} is {text}.", advice="Give whole numbers with commas between them.", setting=setting
        ) from error
    return tuple(dict.fromkeys(numbers))


def _say(**event: object) -> None:
    sys.stdout.write(json_text(event) + "\n")
    sys.stdout.flush()


def _finished(
    json_events: bool, out: Path, result: dict[str, object], tables: list[Table], written: list[Path]
) -> None:
    if json_events:
        _say(event="finished", out=str(out), files=[str(path) for path in written], result=result)
        return
    from rich.table import Table as Drawn

    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    for table in tables:
        drawn = Drawn(title=table.title, title_justify="left")
        for heading in table.headings:
            drawn.add_column(heading)
        for row in table.rows:
            drawn.add_row(*(escape(cell) for cell in row))
        console.print(drawn)
    for path in written:
        sys.stdout.write(f"Wrote {path}\n")

"""``specimap run``, ``info``, ``export``: what a person, or another program by ``--json``, types."""

from __future__ import annotations

import json
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from specimap import __version__
from specimap.cli.progress import Listener, json_listener, progress_listener
from specimap.core.errors import CancelledError, NotFoundError, SpecimapError

REFUSED = 2
"""Exit status of a refused input; 1 is left to failures of the program itself."""
STOPPED = 130

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud with spectra.",
)


class Method(StrEnum):
    """Registration methods."""

    camera = "camera"
    homography = "homography"


class Adjustment(StrEnum):
    """Forms of the joint adjustment."""

    rigid = "rigid"
    free = "free"


class Backend(StrEnum):
    """Reconstruction backends."""

    colmap = "colmap"


class Format(StrEnum):
    """Export formats."""

    ply = "ply"
    las = "las"
    npz = "npz"
    envi = "envi"
    csv = "csv"


@app.command()
def run(
    photos: Annotated[Path, typer.Option(help="Folder of the photos (JPEG, PNG, TIFF, HEIC).")],
    cube: Annotated[Path, typer.Option(help="The cube: an ENVI header, .npy, .npz, HDF5, NetCDF, MATLAB or TIFF.")],
    out: Annotated[Path, typer.Option(help="Folder for the results; an earlier run's is continued.")],
    white: Annotated[Path | None, typer.Option(help="White reference of the cube, for reflectance.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Dark reference of the cube.")] = None,
    edge_mm: Annotated[float, typer.Option(help="Edge of a marker's black square, mm.")] = 6.8,
    dictionary: Annotated[str, typer.Option(help="The markers' ArUco dictionary.")] = "DICT_4X4_50",
    method: Annotated[Method, typer.Option(help="camera removes parallax; homography is the published one.")] = (
        Method.camera
    ),
    adjustment: Annotated[Adjustment, typer.Option(help="rigid squares, or free corners as published.")] = (
        Adjustment.rigid
    ),
    r_pc: Annotated[float, typer.Option(help="Cell of the fine grid, mm.")] = 0.5,
    r_reg: Annotated[float, typer.Option(help="Cell of the coarse grid, mm.")] = 2.0,
    backend: Annotated[Backend, typer.Option(help="Reconstruction backend.")] = Backend.colmap,
    working_px: Annotated[int, typer.Option(help="Longer side that larger photos are brought to.")] = 1280,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")] = False,
) -> None:
    """Reconstruct, adjust, render, register; write cloud.zarr, mesh.ply, report.json, corners.json, preview.png."""
    # Imported late: `specimap --help` and `specimap info` need none of the 3D libraries.
    from specimap.cli.options import settings_from
    from specimap.core.pipeline import Inputs, Outputs, run_pipeline

    listener: Listener = json_listener() if json_events else progress_listener()
    stop = {"asked": False}
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.update(asked=True))
    try:
        settings = settings_from(
            edge_mm=edge_mm, dictionary=dictionary, method=method.value, adjustment=adjustment.value, r_pc=r_pc,
            r_reg=r_reg, backend=backend.value, working_px=working_px,
        )  # fmt: skip
        with listener:
            report = run_pipeline(
                Inputs(photos, cube, white, dark),
                out,
                settings,
                progress=listener.progress,
                cancelled=lambda: stop["asked"],
            )
        listener.finished(report, Outputs(out))
    except SpecimapError as error:
        listener.refused(error)
        raise typer.Exit(STOPPED if isinstance(error, CancelledError) else REFUSED) from None


@app.command()
def info(
    out: Annotated[Path, typer.Argument(help="Folder of a run.")],
    json_events: Annotated[bool, typer.Option("--json", help="Print report.json as it is.")] = False,
) -> None:
    """Print the report of a run."""
    from specimap.cli.tables import print_report
    from specimap.core.report import Report

    path = out / "report.json"
    try:
        if not path.is_file():
            raise NotFoundError(f"{out} holds no report.", advice="Name the folder of a finished run.")
        text = path.read_text(encoding="utf-8")
        if json_events:
            sys.stdout.write(text + "\n")
        else:
            print_report(Report.model_validate_json(text))
    except SpecimapError as error:
        _refuse(error, json_events)


@app.command()
def export(
    out: Annotated[Path, typer.Argument(help="Folder of a run.")],
    format: Annotated[Format, typer.Option(help="What to write.")],
    target: Annotated[Path | None, typer.Option(help="Where to; by default beside the cloud.")] = None,
    json_events: Annotated[bool, typer.Option("--json", help="Answer in one JSON line.")] = False,
) -> None:
    """Write the cloud in another format."""
    from specimap.core.cloud import Cloud
    from specimap.core.export import export_cloud

    try:
        cloud = Cloud.open(out / "cloud.zarr")
        suffix = "hdr" if format is Format.envi else format.value
        written = export_cloud(cloud, target or out / f"cloud.{suffix}", format.value)
    except SpecimapError as error:
        _refuse(error, json_events)
    if json_events:
        sys.stdout.write(json.dumps({"event": "exported", "path": str(written)}) + "\n")
    else:
        typer.echo(f"Wrote {written}")


def _refuse(error: SpecimapError, json_events: bool) -> None:
    (json_listener() if json_events else progress_listener()).refused(error)
    raise typer.Exit(REFUSED)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"specimap {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True)] = False,
) -> None:
    """Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud with spectra."""


def main() -> None:
    """Entry point of the console script."""
    app()

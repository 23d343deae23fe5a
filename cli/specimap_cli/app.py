"""``specimap run``, ``info``, ``export``: what a person, or another program by ``--json``, types."""

from __future__ import annotations

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from specimap_cli import run_options
from specimap_cli.audit import audit_app
from specimap_cli.backup import backup, restore
from specimap_cli.contexts import contexts_app
from specimap_cli.dicom import dicom
from specimap_cli.doctor import doctor
from specimap_cli.erasure import erase, verify_certificate
from specimap_cli.errors import FAILED, Debug, reported_errors, stoppable
from specimap_cli.identity import identity_app
from specimap_cli.keys import keys_app
from specimap_cli.migrate import migrate
from specimap_cli.phantom import phantom
from specimap_cli.progress import Listener, json_listener, progress_listener
from specimap_cli.projects import projects_app
from specimap_cli.report import report
from specimap_cli.storage import storage_app
from specimap_cli.validation import study_app, validate
from specimap_core import __version__
from specimap_core.json_text import json_text
from specimap_core.photos.formats import NAMES
from specimap_core.pipeline.options import DEFAULTS, RunOptions

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud with spectra.",
)

RESEARCH_ONLY = "For research use only. Not a medical device."


class Format(StrEnum):
    """Export formats."""

    ply = "ply"
    las = "las"
    npz = "npz"
    envi = "envi"
    csv = "csv"
    html = "html"
    pdf = "pdf"


class Kind(StrEnum):
    """What a worker's slot is."""

    cpu = "cpu"
    gpu = "gpu"


@app.command()
def run(
    photos: Annotated[Path, typer.Option(help=f"Folder of the photos: {NAMES}.")],
    cube: Annotated[
        Path,
        typer.Option(
            help="The cube: an ENVI header, .npy, .npz, HDF5, NetCDF, MATLAB or TIFF; FILE::DATASET for one of several."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder for the results; an earlier run's is continued.")],
    white: Annotated[Path | None, typer.Option(help="White reference of the cube, for reflectance.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Dark reference of the cube.")] = None,
    edge_mm: run_options.EdgeMm = DEFAULTS.edge_mm,
    dictionary: run_options.Dictionary = DEFAULTS.dictionary,
    method: run_options.Method = DEFAULTS.method,
    adjustment: run_options.Adjustment = DEFAULTS.adjustment,
    r_pc: run_options.FineCellMm = DEFAULTS.r_pc,
    r_reg: run_options.CoarseCellMm = DEFAULTS.r_reg,
    backend: run_options.Backend = DEFAULTS.backend,
    features: run_options.Features = DEFAULTS.features,
    working_px: run_options.WorkingPx = DEFAULTS.working_px,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")] = False,
    debug: Debug = False,
) -> None:
    """Reconstruct, adjust, render, register.

    Writes cloud.zarr, mesh.ply, report.json, corners.json, cameras.json, preview.png.
    """
    listener: Listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        # Imported late: `specimap --help` and `specimap info` need none of the 3D libraries.
        from specimap_core.pipeline.outputs import Inputs, Outputs
        from specimap_core.pipeline.run import run_pipeline
        from specimap_core.pipeline.settings import settings_from
        from specimap_core.reconstruct.backends.environment import backends_from

        options = RunOptions(
            edge_mm=edge_mm,
            dictionary=dictionary,
            r_reg=r_reg,
            r_pc=r_pc,
            working_px=working_px,
            backend=backend,
            features=features,
            method=method,
            adjustment=adjustment,
        )
        backends = backends_from(os.environ, backend)
        settings = settings_from(options, backends.device)
        with listener:
            report = run_pipeline(
                Inputs(photos, cube, white, dark),
                out,
                settings,
                backends=backends,
                progress=listener.progress,
                cancelled=stop_asked,
            )
        listener.finished(report, Outputs(out))


@app.command()
def info(
    out: Annotated[Path, typer.Argument(help="Folder of a run.")],
    json_events: Annotated[bool, typer.Option("--json", help="Print report.json as it is.")] = False,
    debug: Debug = False,
) -> None:
    """Print the report of a run."""
    with reported_errors(json_listener() if json_events else progress_listener(), debug):
        from specimap_cli.tables import print_report
        from specimap_core.report.model import read_report

        report = read_report(out)
        if json_events:
            sys.stdout.write(report.text() + "\n")
        else:
            print_report(report)


@app.command()
def export(
    out: Annotated[Path, typer.Argument(help="Folder of a run.")],
    format: Annotated[Format, typer.Option(help="What to write.")],
    target: Annotated[Path | None, typer.Option(help="Where to; by default beside the cloud.")] = None,
    json_events: Annotated[bool, typer.Option("--json", help="Answer in one JSON line.")] = False,
    debug: Debug = False,
) -> None:
    """Write the cloud in another format."""
    with reported_errors(json_listener() if json_events else progress_listener(), debug):
        from specimap_core.cloud import Cloud
        from specimap_core.export import export_cloud

        cloud = Cloud.open(out / "cloud.zarr")
        suffix = "hdr" if format is Format.envi else format.value
        stem = "report" if format in (Format.html, Format.pdf) else "cloud"
        written = export_cloud(cloud, target or out / f"{stem}.{suffix}", format.value)
        if json_events:
            sys.stdout.write(json_text({"event": "exported", "path": str(written)}) + "\n")
        else:
            typer.echo(f"Wrote {written}")


@app.command()
def serve(
    worker: Annotated[bool, typer.Option(help="Run workers too; without, `specimap worker` runs them.")] = True,
    debug: Debug = False,
) -> None:
    """Start the service: API and workers. Settings come from SPECIMAP_ variables; docs/settings.md lists them."""
    with reported_errors(progress_listener(), debug):
        from specimap_cli.serve import serve as run_service

        run_service(workers=worker, say=typer.echo)


@app.command()
def worker(
    slots: Annotated[int | None, typer.Option(min=1, max=64, help="Jobs side by side.")] = None,
    kind: Annotated[Kind, typer.Option(help="What the slots are.")] = Kind.cpu,
    health: Annotated[
        bool, typer.Option("--health", help="Start nothing: say whether the workers of this machine are alive.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Start workers for a service that runs elsewhere, on the same database and storage."""
    sound = True
    with reported_errors(progress_listener(), debug):
        if health:
            from specimap_cli.health import say_health_of_workers

            sound = say_health_of_workers(typer.echo)
        else:
            from specimap_cli.serve import work

            work(slots=slots, kind=kind.value)
    if not sound:
        raise typer.Exit(FAILED)


@app.command()
def hospital(
    health: Annotated[
        bool, typer.Option("--health", help="Start nothing: say whether this process is alive on this machine.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Send results to the archive and listen to the DICOM port, until Ctrl-C; `specimap serve` does it by itself."""
    sound = True
    with reported_errors(progress_listener(), debug):
        if health:
            from specimap_cli.health import say_health_of_hospital

            sound = say_health_of_hospital(typer.echo)
        else:
            from specimap_cli.serve import run_hospital

            run_hospital()
    if not sound:
        raise typer.Exit(FAILED)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results and the demo's service.")] = Path("out/demo"),
    samples: Annotated[Path, typer.Option(help="Folder of the sample that comes with the source.")] = Path("samples"),
    stay: Annotated[
        bool | None, typer.Option(help="Let the service go on until Ctrl-C; by default on a terminal.")
    ] = None,
    show: Annotated[
        bool, typer.Option("--open", help="Open the result in the browser, and let the service go on until Ctrl-C.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Run the sample through a service of its own: upload, job, progress, report, a link to the result in 3D."""
    listener = progress_listener()
    with reported_errors(listener, debug):
        from specimap_cli.demo import demo as run_demo

        stays = show or (sys.stdout.isatty() if stay is None else stay)
        run_demo(samples, out, listener, stay=stays, show=show, say=typer.echo)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"specimap {__version__}\n{RESEARCH_ONLY}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True)] = False,
) -> None:
    """Photos and one hyperspectral cube of an excised specimen to a metric 3D point cloud with spectra."""


app.command()(report)
app.command()(dicom)
app.command()(validate)
app.command()(phantom)
app.command()(doctor)
app.command()(migrate)
app.command()(backup)
app.command()(restore)
app.command()(erase)
app.command(name="verify-certificate")(verify_certificate)
app.add_typer(study_app, name="study")
app.add_typer(identity_app, name="identity")
app.add_typer(keys_app, name="keys")
app.add_typer(contexts_app, name="contexts")
app.add_typer(projects_app, name="projects")
app.add_typer(storage_app, name="storage")
app.add_typer(audit_app, name="audit")

"""``specimap erase``: everything of a specimen goes, and a signed certificate stays."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from specimap_cli.errors import FAILED, Debug, reported_errors
from specimap_cli.progress import progress_listener
from specimap_cli.service_database import AUDITED_AS, existing_database

if TYPE_CHECKING:
    from specimap_hospital.erasure import Eraser
    from specimap_infra.database import Database
    from specimap_infra.settings import ServiceSettings


def erase(
    specimen: Annotated[
        str, typer.Option(help="Id of the specimen, or - to read it from standard input.", prompt="Specimen")
    ],
    certificate: Annotated[
        Path | None, typer.Option(help="File to write the certificate to, besides standard output.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask again.")] = False,
    debug: Debug = False,
) -> None:
    """Erase a specimen: its acquisitions, files, jobs, results, labels, exports and shares. This cannot be undone."""
    if specimen == "-":
        specimen = sys.stdin.readline().strip()
    if not yes:
        typer.confirm("Everything of this specimen is erased for good. Go on?", abort=True)
    with reported_errors(progress_listener(), debug):
        from specimap_core.atomic import atomic_path
        from specimap_core.json_text import json_text
        from specimap_infra.schema_version import refuse_older
        from specimap_infra.settings import load_settings

        settings = load_settings()
        with existing_database(settings) as database:
            refuse_older(database.engine)
            done = eraser_of(database, settings).erase(specimen, AUDITED_AS)
        text = json_text(done.certificate, indent=1) + "\n"
        sys.stdout.write(text)
        if certificate is not None:
            with atomic_path(certificate) as aside:
                aside.write_text(text, encoding="utf-8")


def verify_certificate(
    certificate: Annotated[Path, typer.Argument(help="File of a certificate.")],
    public_key: Annotated[str, typer.Option(help="The service's public key, as an earlier certificate has it.")],
    debug: Debug = False,
) -> None:
    """Check the signature of a certificate of erasure. Ends with 1 where it is another."""
    with reported_errors(progress_listener(), debug):
        from specimap_hospital.erasure import is_genuine

        genuine = is_genuine(json.loads(certificate.read_text("utf-8")), public_key)
    typer.echo("The certificate is genuine." if genuine else "The certificate is not what was signed.")
    if not genuine:
        raise typer.Exit(FAILED)


def eraser_of(database: Database, settings: ServiceSettings) -> Eraser:
    """Return what erases in the service that the settings name."""
    from specimap_hospital.erasure import Eraser
    from specimap_infra.queue import queue_client
    from specimap_infra.storage import Storage

    return Eraser(database, Storage.open(settings), settings, queue_client(database.engine))

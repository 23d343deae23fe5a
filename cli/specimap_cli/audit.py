"""``specimap audit``: verify the chain, print its head, export and forward the trail."""

from __future__ import annotations

import datetime
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO

import typer

from specimap_cli.errors import FAILED, Debug, reported_errors
from specimap_cli.progress import json_listener, progress_listener
from specimap_cli.service_database import existing_database

if TYPE_CHECKING:
    from specimap_infra.database import Database
    from specimap_infra.settings import ServiceSettings

audit_app = typer.Typer(no_args_is_help=True, help="The audit trail: verify, anchor, export, forward.")
Json = Annotated[bool, typer.Option("--json", help="Answer in one JSON line.")]


class AuditFormat(StrEnum):
    """What an entry is written as."""

    jsonl = "jsonl"
    dicom = "dicom"


@contextmanager
def _opened() -> Iterator[tuple[Database, ServiceSettings]]:
    from specimap_infra.schema_version import refuse_older
    from specimap_infra.settings import load_settings

    settings = load_settings()
    with existing_database(settings) as database:
        refuse_older(database.engine)
        yield database, settings


@audit_app.command()
def verify(
    anchor: Annotated[str, typer.Option(help="What `specimap audit head` printed before: SEQ:HASH.")] = "",
    json_events: Json = False,
    debug: Debug = False,
) -> None:
    """Check that no entry was changed, removed or moved. Ends with 1 where one was."""
    listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug):
        from specimap_infra.audit.records import ChainKeys
        from specimap_infra.audit.verification import Anchor
        from specimap_infra.audit.verification import verify as verify_chain

        given = Anchor.parsed(anchor) if anchor else None
        with _opened() as (database, settings), listener:
            found = verify_chain(
                database, ChainKeys.of(settings), given, lambda share: listener.progress("verify", share)
            )
        fault = found.fault
        text = f"{found.records} records, {found.first} to {found.last}; {found.unsealed} entries wait to be sealed."
        if found.anchored is False and fault is None:
            text += " The anchor names a record that retention has removed."
        if fault is not None:
            text = f"Record {fault.seq} is {fault.kind.replace('_', ' ')}: {fault.what}."
        listener.kept(
            "verified" if fault is None else "broken",
            text,
            records=found.records,
            first=found.first,
            last=found.last,
            head=str(found.head),
            unsealed=found.unsealed,
            anchored=found.anchored,
            kind=None if fault is None else fault.kind,
            seq=None if fault is None else fault.seq,
        )
    if fault is not None:
        raise typer.Exit(FAILED)


@audit_app.command()
def head(debug: Debug = False) -> None:
    """Print the newest place of the chain, SEQ:HASH, to be kept elsewhere: it proves later that nothing was cut off."""
    with reported_errors(progress_listener(), debug):
        from specimap_infra.audit.records import ChainKeys
        from specimap_infra.audit.sealing import seal
        from specimap_infra.audit.verification import chain_head

        with _opened() as (database, settings):
            seal(database, ChainKeys.of(settings))
            with database.session() as session:
                typer.echo(str(chain_head(session)))


@audit_app.command()
def export(
    format: Annotated[AuditFormat, typer.Option(help="Lines of JSON, or DICOM audit messages, one a line.")],
    since: Annotated[
        datetime.datetime | None,
        typer.Option(formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S"], help="Only entries of this time or later, UTC."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File to write; by default standard output.")] = None,
    debug: Debug = False,
) -> None:
    """Write the trail to a file or to standard output."""
    with reported_errors(progress_listener(), debug):
        from specimap_core.atomic import atomic_path
        from specimap_infra.audit.records import ChainKeys
        from specimap_infra.audit.sealing import seal

        begin = None if since is None else since.replace(tzinfo=datetime.UTC)
        with _opened() as (database, settings):
            seal(database, ChainKeys.of(settings))
            if out is None:
                _write(sys.stdout, database, settings, format, begin)
                return
            with atomic_path(out) as aside, open(aside, "w", encoding="utf-8") as file:
                _write(file, database, settings, format, begin)


def _write(
    file: TextIO, database: Database, settings: ServiceSettings, format: AuditFormat, since: datetime.datetime | None
) -> None:
    from specimap_hospital.audit.messages import Source, dicom_message, json_line
    from specimap_hospital.audit.reading import all_sealed

    source = Source(settings.audit_source, settings.audit_site)
    for entry in all_sealed(database, since):
        file.write((json_line(entry) if format is AuditFormat.jsonl else dicom_message(entry, source)) + "\n")


@audit_app.command()
def forward(
    once: Annotated[bool, typer.Option("--once", help="Send what there is, and end.")] = False,
    debug: Debug = False,
) -> None:
    """Send the trail to the syslog server that SPECIMAP_AUDIT_SYSLOG names, until SIGINT or SIGTERM."""
    with reported_errors(progress_listener(), debug):
        from specimap_core.errors import SettingsError
        from specimap_hospital.audit.forwarder import AuditForwarder

        with _opened() as (database, settings):
            if not settings.audit_syslog:
                raise SettingsError(
                    "No syslog server is named.", advice="Set SPECIMAP_AUDIT_SYSLOG.", setting="audit_syslog"
                )
            forwarder = AuditForwarder(database, settings)
            if once:
                total = 0
                while sent := forwarder.step():
                    total += sent
                typer.echo(f"Forwarded {total} entries.")
                return
            stop = threading.Event()
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, lambda *_: stop.set())
            forwarder.run(stop)

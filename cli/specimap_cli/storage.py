"""``specimap storage``: look after the stored files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from specimap_cli.errors import FAILED, Debug, reported_errors, stoppable
from specimap_cli.progress import json_listener, progress_listener
from specimap_cli.service_database import existing_database

storage_app = typer.Typer(no_args_is_help=True, help="The stored files of the service.")


@storage_app.callback()
def _storage() -> None:
    """The stored files of the service."""


@storage_app.command()
def check(
    repair: Annotated[
        bool, typer.Option("--repair", help="Remove files that no row refers to, move strays aside, and mend the rest.")
    ] = False,
    backup: Annotated[
        Path | None, typer.Option("--from", help="With --repair: a backup, from which missing files come back.")
    ] = None,
    checksums: Annotated[bool, typer.Option("--checksums", help="Read every uploaded file, too.")] = False,
    safe_hours: Annotated[
        float, typer.Option(min=1.0, help="Age below which a file without a row is left alone: its row may come.")
    ] = 24.0,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")] = False,
    debug: Debug = False,
) -> None:
    """Compare the stored files with the database, while the service runs. Ends with 1 where something is left to do."""
    listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_infra.schema_version import refuse_older
        from specimap_infra.settings import load_settings
        from specimap_infra.storage import Storage
        from specimap_infra.storage_check import Repaired, check_storage, repair_storage

        settings = load_settings()
        with existing_database(settings) as database:
            refuse_older(database.engine)
            storage = Storage.open(settings)
            with listener:
                found = check_storage(
                    database,
                    storage,
                    safe_hours=safe_hours,
                    checksums=checksums,
                    progress=listener.progress,
                    cancelled=stop_asked,
                )
            mended = Repaired()
            if repair:
                mended = repair_storage(database, storage, settings, found, backup=backup, cancelled=stop_asked)
        orphans, missing = [item.key for item in found.orphans], [reference.key for reference in found.missing]
        damaged, strays = [reference.key for reference in found.damaged], [item.key for item in found.strays]
        listener.kept(
            "checked",
            f"{found.files} files: {len(orphans)} that no row refers to ({sum(o.size for o in found.orphans)} bytes), "
            f"{found.young} of these kept as too young; {len(strays)} strays that are not Specimap's; "
            f"{len(missing)} missing, {len(damaged)} damaged.",
            files=found.files,
            orphans=orphans,
            strays=strays,
            young=found.young,
            missing=missing,
            damaged=damaged,
        )
        if repair:
            listener.kept(
                "repaired",
                f"Removed {len(mended.removed)}, moved aside {len(mended.moved)}, brought back "
                f"{len(mended.brought_back)}, to be made again "
                f"{len(mended.forgotten)}, left {len(mended.left)}.",
                removed=mended.removed,
                moved=mended.moved,
                brought_back=mended.brought_back,
                forgotten=mended.forgotten,
                left=mended.left,
            )
            if not json_events:
                for key, place in mended.moved.items():
                    typer.echo(f"moved aside: {key} to {place}")
        elif not json_events:
            for what, keys in (("no row", orphans), ("stray", strays), ("missing", missing), ("damaged", damaged)):
                for key in keys:
                    typer.echo(f"{what}: {key}")
        for key in mended.left:
            typer.echo(f"still missing or damaged: {key}", err=True)
    if mended.left or not (repair or found.clean):
        raise typer.Exit(FAILED)

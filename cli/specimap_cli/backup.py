"""``specimap backup`` and ``specimap restore``: the whole service as one folder, and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from specimap_cli.erasure import eraser_of
from specimap_cli.errors import Debug, reported_errors, stoppable
from specimap_cli.progress import Listener, json_listener, progress_listener
from specimap_cli.service_database import AUDITED_AS, existing_database

if TYPE_CHECKING:
    from specimap_infra.backup import Manifest
    from specimap_infra.settings import ServiceSettings

Json = Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")]
MIB = 1024**2


def backup(
    to: Annotated[Path, typer.Option(help="Folder to make; it must not exist yet.")],
    previous: Annotated[
        Path | None,
        typer.Option(help="An earlier backup on the same disk: its files are linked instead of copied again."),
    ] = None,
    json_events: Json = False,
    debug: Debug = False,
) -> None:
    """Copy the service's database and stored files into a folder, while it runs.

    Not in it: settings, keys themselves (their hashes are), uploads under way, logs, leases of workers.
    """
    listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_infra.backup import create_backup
        from specimap_infra.settings import load_settings
        from specimap_infra.storage import Storage

        settings = load_settings()
        with existing_database(settings) as database, listener:
            manifest = create_backup(
                database,
                Storage.open(settings),
                to.absolute(),
                previous=previous.absolute() if previous else None,
                progress=listener.progress,
                cancelled=stop_asked,
            )
        _tell(listener, manifest, "saved", to)
    if manifest.missing or manifest.damaged:
        raise typer.Exit(1)


def restore(
    source: Annotated[Path, typer.Option("--from", help="Folder that `specimap backup` made.")],
    check: Annotated[bool, typer.Option("--check", help="Check the backup's checksums only; restore nothing.")] = False,
    erasures: Annotated[
        Path | None,
        typer.Option(
            help="List of erasures since the backup, erasures.jsonl of the data folder that was lost; "
            "by default the one in the data folder."
        ),
    ] = None,
    json_events: Json = False,
    debug: Debug = False,
) -> None:
    """Restore a backup into the empty database and storage that the settings name; before the service's first start."""
    listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_infra.backup import check_backup, restore_backup
        from specimap_infra.settings import load_settings

        with listener:
            if check:
                manifest = check_backup(source.absolute(), progress=listener.progress, cancelled=stop_asked)
            else:
                settings = load_settings()
                manifest = restore_backup(settings, source.absolute(), progress=listener.progress, cancelled=stop_asked)
                erased = _erase_again(settings, erasures)
        _tell(listener, manifest, "checked" if check else "restored", source)
        if not check and erased:
            listener.kept("erased", f"Erased again {erased} specimens that had been erased since.", specimens=erased)


def _erase_again(settings: ServiceSettings, given: Path | None) -> int:
    """Erase what had been erased since the backup; return how many specimens."""
    from specimap_hospital.erasure import LIST, erased_before

    listed = erased_before(given or settings.data_dir / LIST)
    if not listed:
        return 0
    with existing_database(settings) as database:
        return len(eraser_of(database, settings).again(listed, AUDITED_AS))


def _tell(listener: Listener, manifest: Manifest, done: str, folder: Path) -> None:
    listener.kept(
        done,
        f"{done.capitalize()} {sum(manifest.rows.values())} rows and {manifest.files} files, "
        f"{manifest.bytes / MIB:.1f} MiB: {folder}",
        folder=str(folder),
        rows=manifest.rows,
        files=manifest.files,
        bytes=manifest.bytes,
        missing=manifest.missing,
        damaged=manifest.damaged,
    )
    for what, keys in (("missing in the storage", manifest.missing), ("damaged in the storage", manifest.damaged)):
        for key in keys:
            typer.echo(f"{what}: {key}", err=True)

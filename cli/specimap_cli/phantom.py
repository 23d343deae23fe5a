"""``specimap phantom``: a synthetic specimen with exact truth, as an acquisition on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from specimap_cli.errors import Debug, reported_errors, stoppable
from specimap_cli.progress import Listener, json_listener, progress_listener
from specimap_core.errors import CancelledError, SettingsError


def phantom(
    out: Annotated[Path, typer.Option(help="Folder for rgb/, hsi/ and truth.npz; a new or an empty one.")],
    seed: Annotated[int, typer.Option(min=0, help="Another seed is another specimen.")] = 1,
    path_traced: Annotated[
        bool, typer.Option("--path-traced", help="Trace the light, and take photos as a phone does: some minutes.")
    ] = False,
    preset: Annotated[
        str | None, typer.Option(help="Kind of a path-traced one: clean, blurred ... docs/accuracy.md lists them.")
    ] = None,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line per event instead of a bar.")] = False,
    debug: Debug = False,
) -> None:
    """Write a synthetic specimen with exact truth: photos, cube and truth.npz."""
    listener: Listener = json_listener() if json_events else progress_listener()
    with reported_errors(listener, debug), stoppable() as stop_asked:
        from specimap_validation.path_traced.renderer import start_renderer
        from specimap_validation.path_traced.settings import preset as settings_of
        from specimap_validation.phantom import Phantom, PhantomSettings, write_phantom

        if preset is not None and not path_traced:
            raise SettingsError(
                "Only path-traced phantoms have presets.", advice="Add --path-traced.", setting="preset"
            )
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise SettingsError(f"{out} is not empty.", advice="Name a new folder.", setting="out")
        if path_traced:
            settings = settings_of(preset or "clean", seed)
            start_renderer()
            from specimap_validation.path_traced.phantom import TracedPhantom

            made: Phantom = TracedPhantom(settings)
        else:
            made = Phantom(PhantomSettings(seed=seed))

        def progress(share: float) -> None:
            if stop_asked():
                raise CancelledError("Stopped.", advice="What was written so far is no whole phantom.")
            listener.progress("phantom", share)

        with listener:
            progress(0.0)
            write_phantom(made, out, progress=progress)
        listener.kept("written", f"Wrote {out}", out=str(out), photos=made.settings.photos, seed=seed)

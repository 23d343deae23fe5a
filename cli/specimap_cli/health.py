"""``specimap worker --health``: the health check of a worker's container."""

from __future__ import annotations

from collections.abc import Callable

SILENT_LEASES = 9
"""A worker is silent after so many times ``lease_seconds``: one attempt at a database that hangs may take 30 s."""


def say_health_of_workers(say: Callable[[str], None]) -> bool:
    """Tell how the workers of this machine are; return whether they are sound.

    Raises:
        SettingsError: the settings are not those of a service.
    """
    from specimap_infra.heartbeats import health_of
    from specimap_infra.settings import load_settings

    settings = load_settings()
    health = health_of(settings.scratch / "work", SILENT_LEASES * settings.lease_seconds)
    if health.silent:
        say(f"{len(health.silent)} of {len(health.silent) + len(health.lively)} workers here have fallen silent.")
    elif health.lively:
        say(f"Workers alive here: {len(health.lively)}.")
    else:
        say("No worker lives here. One that waits for its database or storage at its start does not count yet.")
    return health.sound

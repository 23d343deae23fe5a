"""``specimap worker --health``: the health check of a worker's container."""

from __future__ import annotations

from collections.abc import Callable


def say_health(say: Callable[[str], None]) -> bool:
    """Tell how the workers of this machine are; return whether they are sound.

    Raises:
        SettingsError: the settings are not those of a service.
    """
    from specimap_infra.settings import load_settings
    from specimap_workers.health import workers_here

    health = workers_here(load_settings())
    if health.silent:
        say(f"{len(health.silent)} of {len(health.silent) + len(health.lively)} workers here have fallen silent.")
    elif health.lively:
        say(f"Workers alive here: {len(health.lively)}.")
    else:
        say("No worker lives here. One that waits for its database or storage at its start does not count yet.")
    return health.sound

"""Judging of arrived files in a child process."""

from __future__ import annotations

from specimap.infra.settings import ServiceSettings


class Judge:
    """To be filled."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings

    def close(self) -> None:
        """Stop the child."""

"""Patience with a database or a storage that is away: work waits for it, and goes on."""

from __future__ import annotations

import tenacity

from specimap_core.errors import OutputNotWritableError, SpecimapError, StorageFullError
from specimap_infra.errors import DatabaseUnavailableError, StorageUnavailableError
from specimap_infra.logs import logger

LONGEST_WAIT_SECONDS = 5.0


def patience(storage_seconds: float) -> tenacity.Retrying:
    """Make what calls a function again while the database or the storage is away.

    For the database it waits without end: while it is away, not even a failure could be written. For the storage it
    gives up after ``storage_seconds`` and raises what the function raised: then a failure with its reason is of more
    use.
    """

    def given_up(state: tenacity.RetryCallState) -> bool:
        error = state.outcome.exception() if state.outcome else None
        return not isinstance(error, DatabaseUnavailableError) and (state.seconds_since_start or 0.0) > storage_seconds

    return tenacity.Retrying(
        retry=tenacity.retry_if_exception_type((DatabaseUnavailableError, StorageUnavailableError)),
        wait=tenacity.wait_exponential_jitter(multiplier=0.2, max=LONGEST_WAIT_SECONDS),
        stop=given_up,
        reraise=True,
    )


PASSING = (DatabaseUnavailableError, StorageUnavailableError, StorageFullError, OutputNotWritableError)
"""What may pass without anybody changing a setting: a worker waits for it."""


def at_start() -> tenacity.Retrying:
    """Make what calls a function until nothing of ``PASSING`` stops it; the log has a line for each time."""
    return tenacity.Retrying(
        retry=tenacity.retry_if_exception_type(PASSING),
        wait=tenacity.wait_exponential_jitter(multiplier=0.2, max=LONGEST_WAIT_SECONDS),
        before_sleep=_say,
        reraise=True,
    )


def _say(state: tenacity.RetryCallState) -> None:
    error = state.outcome.exception() if state.outcome else None
    if isinstance(error, SpecimapError):
        logger().warning("worker waits", code=error.code, message=error.message)

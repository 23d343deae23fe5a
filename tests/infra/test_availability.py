"""Servers that are away: who may try, and what the log says."""

from __future__ import annotations

import time

import pytest
from structlog.testing import capture_logs

from specimap_infra import availability
from specimap_infra.availability import Availability
from specimap_infra.errors import StorageUnavailableError


class AwayError(Exception):
    pass


def refused() -> StorageUnavailableError:
    return StorageUnavailableError("Away.", advice="Wait.")


def attempt(server: Availability, seconds: float = 0.0, error: Exception | None = None) -> None:
    with server.trying(lambda e: isinstance(e, AwayError)):
        time.sleep(seconds)
        if error is not None:
            raise error


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(availability, "SLOW_SECONDS", 0.05)
    monkeypatch.setattr(availability, "RETRY_SECONDS", 0.2)


def test_all_may_try_a_server_that_refuses_at_once() -> None:
    server = Availability("storage", refused, refuses=True)
    for _ in range(3):
        with pytest.raises(AwayError):
            attempt(server, error=AwayError())
    attempt(server)


def test_one_at_a_time_tries_a_server_that_hangs() -> None:
    server = Availability("storage", refused, refuses=True)
    with pytest.raises(AwayError):
        attempt(server, 0.1, AwayError())
    with pytest.raises(StorageUnavailableError):
        attempt(server)
    time.sleep(0.25)
    with server.trying(lambda e: isinstance(e, AwayError)), pytest.raises(StorageUnavailableError):
        attempt(server)
    attempt(server)
    attempt(server)


def test_another_error_neither_begins_nor_ends_an_outage() -> None:
    server = Availability("storage", refused, refuses=True)
    with pytest.raises(ValueError, match="wrong"):
        attempt(server, 0.1, ValueError("wrong"))
    attempt(server)
    with pytest.raises(AwayError):
        attempt(server, 0.1, AwayError())
    time.sleep(0.25)
    with pytest.raises(ValueError, match="wrong"):
        attempt(server, error=ValueError("wrong"))
    attempt(server)


def test_the_log_has_a_line_for_its_beginning_and_one_for_its_end() -> None:
    server = Availability("storage", refused, refuses=False)
    with capture_logs() as lines:
        for _ in range(5):
            with pytest.raises(AwayError):
                attempt(server, error=AwayError("no route\nto it"))
        attempt(server)
        attempt(server)
    assert [line["event"] for line in lines] == ["the storage is away", "the storage is back"]
    assert lines[0]["cause"] == "AwayError: no route"

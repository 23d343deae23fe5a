"""What an error leaves in the log: where it was raised, never the values that were at hand."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import structlog

from specimap_infra.logs import logger, set_up_logs
from specimap_infra.settings import load_settings


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Put the process's logging back."""
    root, config = logging.getLogger(), structlog.get_config()
    was_configured, handlers, level = structlog.is_configured(), list(root.handlers), root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    structlog.reset_defaults()
    if was_configured:
        structlog.configure(**config)


@pytest.mark.parametrize("form", ["json", "text"])
def test_tracebacks_hold_no_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: Literal["json", "text"]
) -> None:
    set_up_logs(load_settings(data_dir=tmp_path, log_format=form))

    def fails(key: str) -> None:
        assert key
        raise ValueError("it broke")

    try:
        fails("spk_" + "1" * 20)
    except ValueError:
        logger().exception("unforeseen", job="job_1")
    text = capsys.readouterr().err
    assert "it broke" in text
    assert "fails" in text
    assert "1" * 20 not in text
    if form == "json":
        entry = json.loads(text)
        assert (entry["event"], entry["level"], entry["job"]) == ("unforeseen", "error", "job_1")
        assert entry["exception"][0]["exc_type"] == "ValueError"


def test_what_a_library_says_again_and_again_is_one_short_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logs(load_settings(data_dir=tmp_path, log_format="json"))
    engine, pool = logging.getLogger("dbos"), logging.getLogger("sqlalchemy.pool")
    for attempt in range(50):
        engine.warning(f"Database connection failed: refused\n[SQL: SELECT {'x' * 1000}]. Retrying ({attempt})")
        try:
            raise ConnectionError("connection 17 is gone\nfor good")
        except ConnectionError:
            pool.exception("Exception during reset")
    engine.warning("Another thing")
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [line["event"] for line in lines] == [
        "Database connection failed: refused",
        "Exception during reset ConnectionError: connection 17 is gone",
        "Another thing",
    ]
    assert not any("exception" in line for line in lines)

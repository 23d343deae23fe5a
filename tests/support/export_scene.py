"""Exports as a worker makes them, for the tests of the service."""

from __future__ import annotations

import os
import time
from typing import Any

from specimap_workers.exports import run_export
from tests.support.result_scene import Result
from tests.support.service_scene import Running


def address(result: Result, format: str) -> str:
    return f"/v1/clouds/{result.cloud_id}/exports/{format}"


def make(service: Running, export_id: str, executor: str = "worker-1", **more: Any) -> None:
    run_export(export_id, service.database, service.storage, service.settings, executor, **more)


def ended(pid: int) -> bool:
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False

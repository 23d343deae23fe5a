"""A job as the service answers."""

from __future__ import annotations

from typing import Any

JOB: dict[str, Any] = {
    "id": "job_1",
    "acquisition_id": "acq_1",
    "settings": {},
    "priority": "routine",
    "state": "queued",
    "stage": None,
    "progress": 0,
    "error": None,
    "starts": 0,
    "rerun_of": None,
    "cloud_id": None,
    "seconds": {},
    "created_at": "2026-11-22T06:00:00Z",
    "started_at": None,
    "finished_at": None,
    "queue_position": 1,
}

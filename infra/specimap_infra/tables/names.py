"""Values of columns: states, priorities, scopes, roles."""

from __future__ import annotations

import sqlalchemy as sa

JOB_STATES = ("queued", "running", "succeeded", "failed", "cancelled")
FINAL_STATES = ("succeeded", "failed", "cancelled")
DICOM_STATES = ("waiting", "sent", "committed", "failed")
PRIORITIES = {"intraoperative": 1, "routine": 5, "research": 9}
SCOPES = ("upload", "read", "label", "intraoperative", "audit", "admin")
ROLES = ("photo", "cube", "white", "dark")
QUEUED = sa.text("state = 'queued'")
"""Condition of the index of queued jobs. A query uses that index where it has the state as text too, not as a value."""

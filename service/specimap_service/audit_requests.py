"""What the audit trail tells of a request: its operation, the object that its address names, how it ended."""

from __future__ import annotations

from starlette.types import Scope

from specimap_service.audit_note import AuditNote
from specimap_service.audit_trail import Access

PREFIX = "/v1/"
READING = ("GET", "HEAD")
READING_POSTS = frozenset({"spectra.select"})
"""Operations that read although they are POST."""
OBJECTS = ("file_id", "upload_id", "share_id", "cloud_id", "job_id", "acquisition_id", "key_id", "project_id", "uuid")
"""Ids in addresses, the most exact one first."""
UNKNOWN = "request"
"""Action of a request that was refused before its operation was known."""


def is_audited(scope: Scope) -> bool:
    """Return whether a request belongs into the trail: to data, not to pages, health or metrics."""
    path: str = scope["path"]
    return path.startswith(PREFIX) and scope["method"] != "OPTIONS"


def access_of(scope: Scope, note: AuditNote, status: int) -> Access | None:
    """Return what the trail tells of a request that was answered with a status; None where an entry of the request's
    own transaction tells it."""
    if status < 400 and note.written:
        return None
    route = scope.get("route")
    operation = getattr(route, "operation_id", None) or getattr(route, "name", None) or UNKNOWN
    given = scope.get("path_params") or {}
    target = next((str(given[name]) for name in OBJECTS if name in given), "")
    # Text of a client that is no id stays out of the trail.
    if not _is_id(target):
        target = ""
    outcome = "success" if status < 400 else "refused" if status < 500 else "failed"
    return Access(note.actor, note.session_id, note.project_id, str(operation), target, outcome, status, note.address)


def _is_id(text: str) -> bool:
    kind, _, rest = text.partition("_")
    return kind.isalpha() and kind.islower() and len(kind) <= 5 and len(rest) == 26 and rest.isalnum()

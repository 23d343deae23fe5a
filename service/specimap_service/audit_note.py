"""What a request leaves behind for the audit trail while it is answered."""

from __future__ import annotations

from contextvars import ContextVar
from dataclasses import dataclass


@dataclass
class AuditNote:
    """Notes on one request; one object in all threads that work for it."""

    address: str = ""
    """As entries keep it."""
    actor: str = ""
    """The key or share, once it is known."""
    project_id: str = ""
    session_id: str = ""
    written: bool = False
    """Whether a transaction of the request has added an entry of its own."""


NOTE: ContextVar[AuditNote | None] = ContextVar("audit_note", default=None)

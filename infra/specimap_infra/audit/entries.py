"""Entries of the audit trail, added within the transaction that they tell of, or in batches by who collects them."""

from __future__ import annotations

import hashlib
import hmac
import secrets
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.audit.sealing import HEAD
from specimap_infra.database import Database
from specimap_infra.projects import acquisition_of, project_of
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import AuditEntry, AuditHead


def new_entry(
    session: Session, actor: str, action: str, target: str, details: dict[str, Any], **more: Any
) -> AuditEntry:
    """Add an entry about an object that is there, and return it.

    ``details`` hold ids and numbers, no names; ``more`` are further columns.

    Raises:
        LookupError: there is no such object.
    """
    project = project_of(session, target)
    if project is None:
        raise LookupError(f"{target} is not there to be written about")
    row = AuditEntry(
        key_id=actor,
        project_id=project,
        action=action,
        target=target,
        details=details,
        acquisition_id=acquisition_of(session, target),
        **{"correlation_id": "", **more},
    )
    session.add(row)
    return row


def name_digest(owner: str, name: str) -> str:
    """Return what an entry keeps of a name that a client gave, such as a layer's: who knows the name finds it again,
    and nobody reads it."""
    return hashlib.sha256(f"{owner}\0{name}".encode()).hexdigest()[:16]


class Addresses:
    """What entries keep of addresses, as the settings say."""

    def __init__(self, database: Database, settings: ServiceSettings) -> None:
        self._database = database
        self._mode = settings.audit_addresses
        self._key = settings.audit_key.get_secret_value().encode()

    def prepare(self) -> None:
        """Read the salt of pseudonyms, where there is no key. Raises DatabaseUnavailableError."""
        if self._mode == "pseudonym" and not self._key:
            self._key = _salt(self._database).encode()

    def of(self, address: str) -> str:
        """Return an address as entries keep it; nothing, too, as long as the salt is not known."""
        if self._mode == "full":
            return address
        if self._mode == "none" or not self._key:
            return ""
        return hmac.new(self._key, f"address\0{address}".encode(), hashlib.sha256).hexdigest()[:16]


def _salt(database: Database) -> str:
    with database.session() as session:
        none_yet = sa.update(AuditHead).where(AuditHead.id == HEAD, AuditHead.salt == "")
        session.execute(none_yet.values(salt=secrets.token_hex(32)), execution_options={"synchronize_session": False})
        return session.get_one(AuditHead, HEAD, populate_existing=True).salt

"""Canonical form and hash of an entry of the audit trail.

A record's hash is over canonical JSON (sorted names, no spaces, UTF-8) of all its fields, its place and the hash of the
record before it: ``sha256:<hex>``, or with a key ``hmac-sha256:<id of the key>:<hex>``.
"""

from __future__ import annotations

import datetime
import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from specimap_core.json_text import json_text
from specimap_infra.settings import ServiceSettings

GENESIS = "0" * 64
"""Hash before the first record."""
FIELDS = (
    *("id", "at", "key_id", "project_id", "acquisition_id", "kind", "action", "target", "outcome", "status"),
    *("address", "count", "details", "correlation_id"),
)
"""Columns of an entry that the hash covers, beside its place in the chain."""


@dataclass(frozen=True)
class ChainKeys:
    """The key that new records are hashed with, if any, and all that older ones may have been."""

    current: bytes | None = field(default=None, repr=False)
    old: tuple[bytes, ...] = field(default=(), repr=False)

    @classmethod
    def of(cls, settings: ServiceSettings) -> ChainKeys:
        """Read them from the settings."""
        current = settings.audit_key.get_secret_value().encode()
        return cls(current or None, tuple(key.get_secret_value().encode() for key in settings.audit_old_keys))

    def hash_of(self, record: bytes) -> str:
        """Return the hash of a new record."""
        if self.current is None:
            return f"sha256:{hashlib.sha256(record).hexdigest()}"
        return _keyed(self.current, record)

    def explains(self, record: bytes, found: str) -> bool:
        """Return whether a record's hash is one that a known key, or none, gives."""
        if found.startswith("sha256:"):
            return hmac.compare_digest(found, f"sha256:{hashlib.sha256(record).hexdigest()}")
        keys = (self.current, *self.old) if self.current else self.old
        return any(key is not None and hmac.compare_digest(found, _keyed(key, record)) for key in keys)

    def knows(self, found: str) -> bool:
        """Return whether a hash is plain, or made with a key that is at hand."""
        keys = (*self.old, *((self.current,) if self.current else ()))
        return found.startswith("sha256:") or found.split(":")[1:2] in [[_id_of(key)] for key in keys]


def _id_of(key: bytes) -> str:
    return hashlib.sha256(b"specimap audit key\0" + key).hexdigest()[:12]


def _keyed(key: bytes, record: bytes) -> str:
    return f"hmac-sha256:{_id_of(key)}:{hmac.new(key, record, hashlib.sha256).hexdigest()}"


def canonical(entry: Mapping[str, Any], seq: int, previous_hash: str) -> bytes:
    """Return the bytes that an entry's hash is over; ``entry`` has the columns of :data:`FIELDS`."""
    values = {name: _plain(entry[name]) for name in FIELDS} | {"seq": seq, "previous_hash": previous_hash}
    return json_text(values, sort_keys=True, ensure_ascii=False, separators=(",", ":")).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, datetime.datetime):
        return value.astimezone(datetime.UTC).isoformat(timespec="microseconds")
    return value

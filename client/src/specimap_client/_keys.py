"""Keys, for administrators."""

from __future__ import annotations

import builtins
import datetime
from collections.abc import Sequence
from typing import Any, Literal

from specimap_client._http import Session, path
from specimap_client._models import Key, NewKey, Project, id_of

Scope = Literal["upload", "read", "label", "intraoperative", "audit", "admin"]


class Keys:
    """``client.keys``. All need the scope ``admin``."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def create(
        self,
        name: str,
        scopes: Sequence[Scope],
        *,
        project: Project | str | None = None,
        expires_at: datetime.datetime | None = None,
        rate_per_minute: int | None = None,
        quota_bytes: int | None = None,
    ) -> NewKey:
        """A new key; its ``key`` is shown this once. ``expires_at`` is aware.

        ``project``: by default that of this client's key; a text is its id or name.
        """
        body: dict[str, Any] = {
            "name": name,
            "scopes": builtins.list(scopes),
            "rate_per_minute": rate_per_minute,
            "quota_bytes": quota_bytes,
            "expires_at": None if expires_at is None else expires_at.astimezone(datetime.UTC).isoformat(),
        }
        if project is not None:
            body["project"] = id_of(project)
        return NewKey.of(self._session.create(path("keys"), body))

    def list(self, *, project: Project | str | None = None) -> builtins.list[Key]:
        """All keys, revoked ones too; or those of one project."""
        wanted = {} if project is None else {"project": id_of(project)}
        return [Key.of(item) for item in self._session.json("GET", path("keys"), params=wanted)]

    def revoke(self, key: Key | str) -> None:
        """Revoke a key by its id; it is refused within two seconds everywhere."""
        self._session.request("DELETE", path("keys", id_of(key)))

"""Requests that may be sent again: under the same `Idempotency-Key` they make one object, however often they arrive."""

from __future__ import annotations

import datetime
import hashlib
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import sqlalchemy as sa
from fastapi import Header
from pydantic import BaseModel
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from specimap_core.json_text import json_text
from specimap_infra.database import Database, utc_now
from specimap_infra.housekeeping import REQUEST_DAYS
from specimap_infra.tables import RepeatableRequest
from specimap_service.auth.keys import Principal
from specimap_service.errors import IdempotencyConflictError

KEPT = datetime.timedelta(days=REQUEST_DAYS)
"""How long a request may be sent again."""
IdempotencyKey = Annotated[
    str | None,
    Header(
        pattern=r"^[\x20-\x7e]{1,128}$",
        description="A name for this request: sent again with the same name by the same key within 7 days, it returns "
        "what it created before.",
    ),
]
T = TypeVar("T")
_KINDS = {"acq": "acquisition", "exp": "export", "prj": "project", "shr": "share", "up": "upload"}


def repeated(model: type[BaseModel]) -> dict[int | str, dict[str, Any]]:
    """Make the description of the answer to a request that was made before."""
    return {200: {"model": model, "description": "Created before by the same request"}}


def digest_of(request: dict[str, Any]) -> str:
    """Return the SHA-256 of a request's values."""
    return hashlib.sha256(json_text(request, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Repeatable:
    """A request: the key that makes it, the name it has for that key, if any, and a hash of what it asks for."""

    key_id: str
    name: str | None
    digest: str

    @classmethod
    def of(cls, principal: Principal, name: str | None, operation: str, request: dict[str, Any]) -> Repeatable:
        """Describe a request by its operation and its values."""
        return cls(principal.key_id, name, digest_of({"operation": operation, **request}))

    def once(
        self,
        database: Database,
        make: Callable[[Session, str], tuple[str, T]],
        again: Callable[[Session, str, str], T],
    ) -> tuple[T, bool]:
        """Make an object, or find the one that the same request made; return it, and whether it is new.

        Args:
            make: makes it within a transaction and returns its id and itself.
            again: finds it by its id. Both get last a salt, which stays the same as long as the request is kept.

        Raises:
            IdempotencyConflictError: another request had this name.
            sqlalchemy.exc.IntegrityError: what ``make`` writes contradicts what is there.
        """
        found = self._repeated(database, again)
        if found is not None:
            return found[0], False
        salt = secrets.token_hex(16)
        try:
            with database.session() as session:
                row = None if self.name is None else self._claimed(session, self.name, salt)
                object_id, made = make(session, salt)
                if row is not None:
                    row.object_id = object_id
                return made, True
        except IntegrityError:
            # Perhaps the same request came twice at once.
            found = self._repeated(database, again)
            if found is None:
                raise
            return found[0], False

    def _claimed(self, session: Session, name: str, salt: str) -> RepeatableRequest:
        """Take the name before anything is made: a second request waits here until the first is through."""
        old = RepeatableRequest.created_at < utc_now() - KEPT
        session.execute(sa.delete(RepeatableRequest).where(self._mine(), old))
        row = RepeatableRequest(key_id=self.key_id, name=name, request_hash=self.digest, object_id="", salt=salt)
        session.add(row)
        session.flush()
        return row

    def _repeated(self, database: Database, again: Callable[[Session, str, str], T]) -> tuple[T] | None:
        if self.name is None:
            return None
        with database.session() as session:
            query = sa.select(RepeatableRequest).where(self._mine(), RepeatableRequest.created_at >= utc_now() - KEPT)
            row = session.scalar(query)
            if row is None:
                return None
            if row.request_hash != self.digest:
                kind = row.object_id.partition("_")[0]
                raise IdempotencyConflictError(
                    f"The idempotency key was used for another request, which made {row.object_id}.",
                    advice="Use a new key for a new request.",
                    **{f"{_KINDS.get(kind, kind)}_id": row.object_id},
                )
            return (again(session, row.object_id, row.salt),)

    def _mine(self) -> sa.ColumnElement[bool]:
        return sa.and_(RepeatableRequest.key_id == self.key_id, RepeatableRequest.name == self.name)

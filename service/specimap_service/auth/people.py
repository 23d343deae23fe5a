"""People who sign in with an identity provider: rows that name them by a pseudonym, and what they were granted."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import Person, SignIn


@dataclass(frozen=True)
class Granted:
    """A person, with the roles and the projects that the identity provider gives it."""

    person_id: str
    roles: tuple[str, ...]
    project_ids: tuple[str, ...]

    def stored(self) -> dict[str, Any]:
        """Write what a session keeps of it."""
        return {"roles": list(self.roles), "projects": list(self.project_ids)}

    @classmethod
    def of_session(cls, row: SignIn) -> Granted:
        """Read what a session of a person keeps."""
        kept = row.granted or {}
        return cls(row.person_id or "", tuple(kept.get("roles", ())), tuple(kept.get("projects", ())))


def subject_hash(issuer: str, subject: str) -> str:
    """Return what is kept of an account's id at its provider."""
    return hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()


def known_person(session: Session, issuer: str, subject: str) -> Person:
    """Return the row of an account, made when the account is first seen."""
    query = sa.select(Person).where(Person.issuer == issuer, Person.subject_hash == subject_hash(issuer, subject))
    found = session.scalar(query)
    if found is not None:
        return found
    made = Person(id=new_id("person"), issuer=issuer, subject_hash=subject_hash(issuer, subject), created_at=utc_now())
    try:
        with session.begin_nested():
            session.add(made)
    except IntegrityError:
        # Another request has met the same account at the same moment.
        return session.scalars(query).one()
    return made


def pseudonym(person_id: str) -> str:
    """Return the name under which pages show a person."""
    return f"person {person_id[-6:]}"

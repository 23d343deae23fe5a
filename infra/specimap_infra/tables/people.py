"""Tables of people who sign in with an identity provider."""

from __future__ import annotations

import datetime

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base


class Person(Base):
    """A person, or a program with an account, of the identity provider: a pseudonym, of which no name is kept."""

    __tablename__ = "people"
    __table_args__ = (sa.UniqueConstraint("issuer", "subject_hash"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    issuer: Mapped[str]
    subject_hash: Mapped[str]
    """SHA-256 of the issuer and the provider's id of the account."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    last_used_at: Mapped[datetime.datetime | None]
    blocked_at: Mapped[datetime.datetime | None]
    """From then on neither sessions nor tokens of the person count, whatever the provider says."""


class SignInAttempt(Base):
    """A sign-in under way at the identity provider. It ends with the provider's answer, or after some minutes."""

    __tablename__ = "sign_in_attempts"

    id: Mapped[str] = mapped_column(primary_key=True)
    """SHA-256 of the ``state`` that the provider sends back."""
    browser_hash: Mapped[str]
    """SHA-256 of the cookie of the browser that began it: no other may end it."""
    nonce: Mapped[str]
    code_verifier: Mapped[str]
    """Of PKCE."""
    return_to: Mapped[str]
    """What the page's address had after ``#``."""
    session_before: Mapped[str | None]
    """The session that the browser had; it ends with the sign-in."""
    expires_at: Mapped[datetime.datetime] = mapped_column(index=True)

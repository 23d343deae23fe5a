"""Keys, created, listed and revoked by an administrator; and the audit trail."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from fastapi import APIRouter, Path, Query
from pydantic import BaseModel, ConfigDict, Field

from specimap_core.errors import NotFoundError
from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey, AuditEntry
from specimap_service.auth.dependencies import Admin, KeyringDep
from specimap_service.auth.keys import new_key
from specimap_service.context import Context, audit
from specimap_service.errors import RequestInvalidError
from specimap_service.paging import Limit, Moment, Page, page_of

router = APIRouter(prefix="/v1", tags=["keys"])
KeyId = Annotated[str, Path(pattern=r"^key_[0-9a-z]{26}$")]


class KeyRequest(BaseModel):
    """A key to be created."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"name": "tablet 3", "scopes": ["upload", "read"]}}
    )

    name: str = Field(min_length=1, max_length=100, description="Whose key it is; no patient's name.")
    scopes: list[Literal["upload", "read", "label", "admin"]] = Field(min_length=1, fail_fast=True)
    expires_at: Moment | None = Field(default=None, description="From when on it is refused; not in the past.")
    rate_per_minute: int | None = Field(default=None, ge=1, le=10_000_000)
    quota_bytes: int | None = Field(default=None, ge=1, le=2**60)


class Key(BaseModel):
    """A key, without its secret."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    name: str
    scopes: list[str]
    created_at: datetime.datetime
    expires_at: datetime.datetime | None
    revoked_at: datetime.datetime | None
    last_used_at: datetime.datetime | None
    rate_per_minute: int | None
    quota_bytes: int | None


class NewKey(Key):
    """A key that was just created."""

    key: str = Field(description="The key itself; it is shown this once and kept nowhere.")


class Audited(BaseModel):
    """An entry of the audit trail: which key did what to which object."""

    model_config = ConfigDict(from_attributes=True)

    id: int
    at: datetime.datetime
    key_id: str
    action: str
    target: str
    details: dict[str, Any]
    correlation_id: str


@router.post("/keys", status_code=201)
def create_key(context: Context, principal: Admin, wanted: KeyRequest) -> NewKey:
    """Create a key."""
    if wanted.expires_at is not None and wanted.expires_at <= utc_now():
        raise RequestInvalidError(
            "body.expires_at: the time has passed.",
            advice="Give a later time, with its zone.",
            fields=[{"where": "body.expires_at", "what": "the time has passed"}],
        )
    row, key = new_key(
        wanted.name,
        wanted.scopes,
        expires_at=wanted.expires_at,
        rate_per_minute=wanted.rate_per_minute,
        quota_bytes=wanted.quota_bytes,
    )
    with context.database.session() as session:
        session.add(row)
        audit(session, principal.key_id, "key.create", row.id, scopes=row.scopes)
    return NewKey(**Key.model_validate(row).model_dump(), key=key)


@router.get("/keys")
def list_keys(context: Context, principal: Admin) -> list[Key]:
    """List all keys, revoked ones too."""
    with context.database.session() as session:
        return [Key.model_validate(row) for row in session.scalars(sa.select(ApiKey).order_by(ApiKey.id))]


@router.delete("/keys/{key_id}", status_code=204)
def revoke_key(context: Context, principal: Admin, keyring: KeyringDep, key_id: KeyId) -> None:
    """Revoke a key; it is refused within two seconds everywhere."""
    with context.database.session() as session:
        row = session.get(ApiKey, key_id)
        if row is None:
            raise NotFoundError(f"There is no key {key_id}.", advice="GET /v1/keys lists all.")
        row.revoked_at = row.revoked_at or utc_now()
        audit(session, principal.key_id, "key.revoke", key_id)
    keyring.forget()


@router.get("/audit")
def list_audit(
    context: Context,
    principal: Admin,
    target: Annotated[
        str | None, Query(pattern=r"^[a-z]{2,5}_[0-9a-z]{26}$", description="Only entries about this object.")
    ] = None,
    after: Annotated[int | None, Query(ge=1, description="`next` of the page before.")] = None,
    limit: Limit = 100,
) -> Page[Audited]:
    """List the audit trail, newest entry first."""
    query = sa.select(AuditEntry).order_by(AuditEntry.id.desc()).limit(limit + 1)
    if target is not None:
        query = query.where(AuditEntry.target == target)
    if after is not None:
        query = query.where(AuditEntry.id < after)
    with context.database.session() as session:
        rows = list(session.scalars(query))
    return page_of([Audited.model_validate(row) for row in rows], [str(row.id) for row in rows], limit)

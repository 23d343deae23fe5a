"""Keys, created, listed and revoked by an administrator; and the audit trail."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from fastapi import APIRouter, Query
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from specimap_infra.database import utc_now
from specimap_infra.projects import found_project
from specimap_infra.tables import ApiKey, AuditEntry
from specimap_service.auth.access import in_sight, load
from specimap_service.auth.dependencies import Admin, KeyringDep
from specimap_service.auth.keys import checked_name, new_key
from specimap_service.auth.object_ids import KeyId
from specimap_service.context import Context, audit
from specimap_service.errors import RequestInvalidError
from specimap_service.paging import InProject, Limit, Moment, Page, page_of

router = APIRouter(prefix="/v1", tags=["keys"])


class KeyRequest(BaseModel):
    """A key to be created."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"name": "tablet 3", "scopes": ["upload", "read"], "project": "study-7"}},
    )

    name: Annotated[str, AfterValidator(checked_name)] = Field(
        min_length=1, max_length=100, description="Whose key it is; no patient's name. No control characters."
    )
    scopes: list[Literal["upload", "read", "label", "intraoperative", "admin"]] = Field(min_length=1, fail_fast=True)
    project: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9._-]{1,64}$",
        description="Id or name of its project, for good; by default the project of the key that creates it.",
    )
    expires_at: Moment | None = Field(default=None, description="From when on it is refused; not in the past.")
    rate_per_minute: int | None = Field(default=None, ge=1, le=10_000_000)
    quota_bytes: int | None = Field(default=None, ge=1, le=2**60)


class Key(BaseModel):
    """A key, without its secret."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    project_id: str
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
    project_id: str = Field(description="The target's project.")
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
    with context.database.session() as session:
        project_id = principal.project_id if wanted.project is None else found_project(session, wanted.project).id
        row, key = new_key(
            wanted.name,
            wanted.scopes,
            project_id=project_id,
            expires_at=wanted.expires_at,
            rate_per_minute=wanted.rate_per_minute,
            quota_bytes=wanted.quota_bytes,
        )
        session.add(row)
        audit(session, principal.key_id, "key.create", row.id, scopes=row.scopes)
    return NewKey(**Key.model_validate(row).model_dump(), key=key)


@router.get("/keys")
def list_keys(context: Context, principal: Admin, project: InProject = None) -> list[Key]:
    """List all keys, revoked ones too."""
    query = sa.select(ApiKey).where(in_sight(principal, ApiKey, project)).order_by(ApiKey.id)
    with context.database.session() as session:
        return [Key.model_validate(row) for row in session.scalars(query)]


@router.delete("/keys/{key_id}", status_code=204)
def revoke_key(context: Context, principal: Admin, keyring: KeyringDep, key_id: KeyId) -> None:
    """Revoke a key; it is refused within two seconds everywhere."""
    with context.database.session() as session:
        row = load(session, principal, ApiKey, key_id)
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
    project: InProject = None,
    after: Annotated[int | None, Query(ge=1, le=10**18, description="`next` of the page before.")] = None,
    limit: Limit = 100,
) -> Page[Audited]:
    """List the audit trail, newest entry first."""
    query = (
        sa.select(AuditEntry)
        .where(in_sight(principal, AuditEntry, project))
        .order_by(AuditEntry.id.desc())
        .limit(limit + 1)
    )
    if target is not None:
        query = query.where(AuditEntry.target == target)
    if after is not None:
        query = query.where(AuditEntry.id < after)
    with context.database.session() as session:
        rows = list(session.scalars(query))
    return page_of([Audited.model_validate(row) for row in rows], [str(row.id) for row in rows], limit)

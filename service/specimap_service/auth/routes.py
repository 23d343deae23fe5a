"""Keys, created, listed and revoked by an administrator."""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey
from specimap_service.auth.access import in_sight, load, project_for_new
from specimap_service.auth.credentials import credential_of, is_secret_of
from specimap_service.auth.dependencies import KeyringDep, Permitted
from specimap_service.auth.keys import checked_name, derived_secret, key_text, new_key
from specimap_service.auth.object_ids import KeyId
from specimap_service.context import Context, audit
from specimap_service.errors import IdempotencyConflictError, RequestInvalidError
from specimap_service.idempotency import IdempotencyKey, Repeatable, repeated
from specimap_service.paging import After, InProject, MaybeLimit, Moment, Sort, listed, paged

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
    scopes: list[Literal["upload", "read", "label", "intraoperative", "audit", "admin"]] = Field(
        min_length=1, fail_fast=True
    )
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

    key: str = Field(
        description="The key itself; it is shown this once, or again for the same Idempotency-Key, and kept nowhere."
    )


@router.post("/keys", status_code=201, responses=repeated(NewKey), operation_id="keys.create")
def create_key(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    wanted: KeyRequest,
    idempotency_key: IdempotencyKey = None,
) -> NewKey:
    """Create a key."""
    if wanted.expires_at is not None and wanted.expires_at <= utc_now():
        raise RequestInvalidError(
            "body.expires_at: the time has passed.",
            advice="Give a later time, with its zone.",
            fields=[{"where": "body.expires_at", "what": "the time has passed"}],
        )
    own = credential_of(request)

    def make(session: Session, salt: str) -> tuple[str, NewKey]:
        project_id = project_for_new(session, principal, wanted.project)
        row, key = new_key(
            wanted.name,
            wanted.scopes,
            project_id=project_id,
            expires_at=wanted.expires_at,
            rate_per_minute=wanted.rate_per_minute,
            quota_bytes=wanted.quota_bytes,
            secret=None if idempotency_key is None else derived_secret(own, salt),
        )
        session.add(row)
        audit(session, principal.key_id, "key.create", row.id, scopes=row.scopes)
        return row.id, NewKey(**Key.model_validate(row).model_dump(), key=key)

    def again(session: Session, key_id: str, salt: str) -> NewKey:
        row, secret = load(session, principal, ApiKey, key_id), derived_secret(own, salt)
        if not is_secret_of(row, secret):
            raise IdempotencyConflictError(
                f"Another session of this key, or the key itself, made {key_id}: only there it is shown again.",
                advice="Revoke it, and create another with a new idempotency key.",
                key_id=key_id,
            )
        return NewKey(**Key.model_validate(row).model_dump(), key=key_text(key_id, secret))

    repeatable = Repeatable.of(principal, idempotency_key, "keys.create", wanted.model_dump(mode="json"))
    key, new = repeatable.once(context.database, make, again)
    response.status_code = 201 if new else 200
    return key


@router.get("/keys", operation_id="keys.list")
def list_keys(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    project: InProject = None,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "created_at",
) -> list[Key]:
    """List the keys, revoked ones too."""
    query = paged(sa.select(ApiKey).where(in_sight(principal, ApiKey, project)), ApiKey.id, after, limit, sort)
    with context.database.session() as session:
        keys = [Key.model_validate(row) for row in session.scalars(query)]
    return listed(request, response, keys, [key.id for key in keys], limit)


@router.delete("/keys/{key_id}", status_code=204, operation_id="keys.revoke")
def revoke_key(context: Context, principal: Permitted, keyring: KeyringDep, key_id: KeyId) -> None:
    """Revoke a key; it is refused within two seconds everywhere."""
    with context.database.session() as session:
        row = load(session, principal, ApiKey, key_id)
        row.revoked_at = row.revoked_at or utc_now()
        audit(session, principal.key_id, "key.revoke", key_id)
    keyring.forget()

"""Shares: links to one result for people without a key, made and revoked by those who upload."""

from __future__ import annotations

import datetime
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from specimap_infra import tables
from specimap_infra.database import utc_now
from specimap_service.auth.access import load, not_found
from specimap_service.auth.credentials import credential_of, is_secret_of
from specimap_service.auth.dependencies import KeyringDep, Permitted, check_permission
from specimap_service.auth.keys import checked_name, derived_secret
from specimap_service.auth.object_ids import CloudId, ShareId
from specimap_service.auth.permissions import READ
from specimap_service.auth.shares import MOST_DAYS, new_share, share_text
from specimap_service.context import Context, audit
from specimap_service.errors import (
    IdempotencyConflictError,
    QuotaExceededError,
    RequestInvalidError,
)
from specimap_service.idempotency import IdempotencyKey, Repeatable, repeated
from specimap_service.paging import After, MaybeLimit, Moment, Sort, listed, paged

MOST_VALID = 100
"""Of one result at a time."""
router = APIRouter(prefix="/v1/clouds/{cloud_id}/shares", tags=["shares"])


class ShareRequest(BaseModel):
    """A share to be created."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"name": "tumour board", "expires_at": "2027-01-15T00:00:00Z"}}
    )

    name: Annotated[str, AfterValidator(checked_name)] = Field(
        min_length=1, max_length=100, description="Who it is for; no patient's name. No control characters."
    )
    expires_at: Moment = Field(description=f"From when on the link shows nothing; within {MOST_DAYS} days.")


class Share(BaseModel):
    """A link to one result, without its secret."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    cloud_id: str
    name: str
    created_at: datetime.datetime
    created_by: str = Field(description="The key that made it: the share ends with it.")
    expires_at: datetime.datetime
    revoked_at: datetime.datetime | None
    last_used_at: datetime.datetime | None


class NewShare(Share):
    """A share that was just created."""

    token: str = Field(
        description="What its link holds; shown this once, or again for the same Idempotency-Key, and kept nowhere."
    )


@router.post("", status_code=201, responses=repeated(NewShare), operation_id="shares.create")
def create_share(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    wanted: ShareRequest,
    idempotency_key: IdempotencyKey = None,
) -> NewShare:
    """Create a link that shows this result, and nothing else, to whoever has it; the key needs the scope `read` too.

    `POST /v1/session` takes the token. The share ends when it expires or is revoked, and with the key that made it.
    """
    # Nobody gives what they have not.
    check_permission(principal, READ)
    _check_end(wanted.expires_at)
    own = credential_of(request)

    def make(session: Session, salt: str) -> tuple[str, NewShare]:
        load(session, principal, tables.CloudRow, cloud_id)
        _check_room(session, cloud_id)
        row, token = new_share(
            cloud_id,
            wanted.name,
            wanted.expires_at,
            created_by=principal.key_id,
            secret=None if idempotency_key is None else derived_secret(own, salt),
        )
        session.add(row)
        session.flush()
        audit(session, principal.key_id, "share.create", row.id, cloud=cloud_id)
        return row.id, NewShare(**Share.model_validate(row).model_dump(), token=token)

    def again(session: Session, share_id: str, salt: str) -> NewShare:
        row, secret = _found(session, cloud_id, share_id), derived_secret(own, salt)
        if not is_secret_of(row, secret):
            raise IdempotencyConflictError(
                f"Another session of this key, or the key itself, made {share_id}: only there it is shown again.",
                advice="Revoke it, and create another with a new idempotency key.",
                share_id=share_id,
            )
        return NewShare(**Share.model_validate(row).model_dump(), token=share_text(share_id, secret))

    asked = {"cloud_id": cloud_id, **wanted.model_dump(mode="json")}
    share, new = Repeatable.of(principal, idempotency_key, "shares.create", asked).once(context.database, make, again)
    response.status_code = 201 if new else 200
    return share


@router.get("", operation_id="shares.list")
def list_shares(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "-created_at",
) -> list[Share]:
    """List the shares of a result, also those that have ended."""
    query = sa.select(tables.Share).where(tables.Share.cloud_id == cloud_id)
    with context.database.session() as session:
        load(session, principal, tables.CloudRow, cloud_id)
        rows = session.scalars(paged(query, tables.Share.id, after, limit, sort))
        shares = [Share.model_validate(row) for row in rows]
    return listed(request, response, shares, [share.id for share in shares], limit)


@router.delete("/{share_id}", status_code=204, operation_id="shares.revoke")
def revoke_share(
    context: Context, principal: Permitted, keyring: KeyringDep, cloud_id: CloudId, share_id: ShareId
) -> None:
    """Revoke a share; whoever came by its link is refused within two seconds everywhere."""
    with context.database.session() as session:
        row = _found(session, cloud_id, share_id)
        row.revoked_at = row.revoked_at or utc_now()
        audit(session, principal.key_id, "share.revoke", share_id, cloud=cloud_id)
    keyring.forget()


def _check_room(session: Session, cloud_id: str) -> None:
    """Raise QuotaExceededError where a result has as many valid shares as it may have: each has a rate of its own."""
    valid = tables.Share.revoked_at.is_(None) & (tables.Share.expires_at > utc_now())
    count = sa.select(sa.func.count()).select_from(tables.Share).where(tables.Share.cloud_id == cloud_id, valid)
    if (session.scalar(count) or 0) >= MOST_VALID:
        raise QuotaExceededError(
            f"The result has {MOST_VALID} shares that are valid.",
            advice="Revoke those that are not needed any more.",
            limit=MOST_VALID,
        )


def _found(session: Session, cloud_id: str, share_id: str) -> tables.Share:
    row = session.get(tables.Share, share_id)
    if row is None or row.cloud_id != cloud_id:
        raise not_found(share_id)
    return row


def _check_end(end: datetime.datetime) -> None:
    now = utc_now()
    if end <= now:
        what, advice = "the time has passed", "Give a later time, with its zone."
    elif end > now + datetime.timedelta(days=MOST_DAYS):
        what, advice = f"more than {MOST_DAYS} days from now", f"Give a time within {MOST_DAYS} days."
    else:
        return
    raise RequestInvalidError(
        f"body.expires_at: {what}.", advice=advice, fields=[{"where": "body.expires_at", "what": what}]
    )

"""Signing in with a key on the service's own pages, and signing out."""

from __future__ import annotations

import datetime
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator
from sqlalchemy.orm import Session as OrmSession

from specimap_infra.database import utc_now
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import SCOPES, ApiKey, Person, Project, Share, SignIn
from specimap_service.auth.credentials import COOKIE, Credential
from specimap_service.auth.dependencies import KeyringDep, Known, known_by
from specimap_service.auth.keys import Principal
from specimap_service.auth.people import pseudonym
from specimap_service.auth.sessions import end_session, new_session, session_id
from specimap_service.auth.shares import maker_of
from specimap_service.context import AppContext, Context, audit
from specimap_service.errors import UnauthorizedError

router = APIRouter(prefix="/v1", tags=["sessions"])


Secret = Annotated[str, StringConstraints(pattern=r"^[\x21-\x7e]{1,200}$")]


class SessionRequest(BaseModel):
    """What a person signs in with: a key, or a share's token."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {"key": f"spk_{'0' * 26}_{'0' * 64}"},
            "oneOf": [{"required": ["key"]}, {"required": ["share"]}],
        },
    )

    key: Secret = Field(default_factory=str, description="A key, `spk_…`.")
    share: Secret = Field(default_factory=str, description="What the link of a share holds, `sps_…`.")

    @model_validator(mode="after")
    def _one(self) -> SessionRequest:
        if bool(self.key) == bool(self.share):
            raise ValueError("give either a key or a share")
        return self


class SeenProject(BaseModel):
    """A project by its id and its name."""

    id: str
    name: str


class Session(BaseModel):
    """Who asks: a key, directly or by a session, a person of the identity provider, or a share."""

    key_id: str = Field(description="Of the key; of the person; of the share, for a session that its link made.")
    name: str = Field(description="Of the key, or of the share; of a person a pseudonym.")
    project_id: str = Field(description="The first of its projects; empty for a person without any.")
    project: str = Field(description="That project's name.")
    projects: list[SeenProject] = Field(description="All its projects; one needs no more than that where it is admin.")
    scopes: list[str] = Field(description="Of a person: those that the roles make up.")
    roles: list[str] = Field(description="Of a person of the identity provider.")
    permissions: list[str] = Field(description="What it may; docs/identity.md lists all.")
    expires_at: datetime.datetime | None = Field(description="When the session ends; for a key, when that expires.")
    cloud_id: str | None = Field(description="The one cloud that the session sees, if it was made by a share's link.")


@router.post("/session", status_code=201, operation_id="sessions.create")
async def create_session(context: Context, request: Request, response: Response, wanted: SessionRequest) -> Session:
    """Sign in with a key or by a share's link: the answer sets a cookie that stands for it until the session ends.

    For pages of the service itself: it takes the header `Specimap-Page: 1`, as every later request with the cookie that
    changes something does. A session that the request's cookie names already ends.
    """
    # Wrong keys count like those in headers.
    presented = Credential("key", wanted.key) if wanted.key else Credential("share", wanted.share)
    principal = await known_by(request, presented)
    made, token = await run_in_threadpool(_begin, context, principal, request.cookies.get(COOKIE))
    assert made.expires_at is not None
    seconds = (made.expires_at - utc_now()).total_seconds()
    set_cookie(response, request, context.settings, token, max(1, int(seconds)))
    return made


@router.get("/session", operation_id="sessions.get")
def get_session(context: Context, principal: Known, response: Response) -> Session:
    """Tell who asks: the key or person, its projects, what it may do, and until when."""
    response.headers["Cache-Control"] = "no-store"
    with context.database.session() as session:
        holder = _holder(session, principal)
        row = None if principal.session_id is None else session.get(SignIn, principal.session_id)
        ends = None if isinstance(holder, Person) else holder.expires_at
        return _view(session, principal, holder, ends if row is None else row.expires_at)


@router.delete("/session", status_code=204, operation_id="sessions.delete")
def delete_session(context: Context, principal: Known, keyring: KeyringDep, request: Request) -> Response:
    """Sign out: the session ends, everywhere within two seconds, and the cookie goes. A key alone has none to end."""
    end_of_token(context, request.cookies.get(COOKIE))
    keyring.forget()
    response = Response(status_code=204)
    set_cookie(response, request, context.settings, "", 0)
    return response


def _begin(context: AppContext, principal: Principal, before: str | None) -> tuple[Session, str]:
    end_of_token(context, before)
    with context.database.session() as session:
        holder = _holder(session, principal)
        share = holder if isinstance(holder, Share) else None
        maker = maker_of(session, holder) if isinstance(holder, Share) else holder
        if maker is None:
            raise _ended()
        row, token = new_session(session, maker, context.settings.session_hours, share=share)
        if share is None:
            audit(session, maker.id, "session.create", maker.id)
        else:
            audit(session, share.id, "share.open", share.id, cloud=share.cloud_id)
        return _view(session, principal, holder, row.expires_at), token


def end_of_token(context: AppContext, token: str | None) -> None:
    """End the session of a token, if there is one."""
    if token is not None:
        with context.database.session() as session:
            end_audited(session, session_id(token))


def end_audited(session: OrmSession, row_id: str) -> None:
    """End a session by its id, if it has not ended, and say so in the audit trail."""
    row = end_session(session, row_id)
    if row is not None:
        holder = row.key_id or row.person_id or ""
        # The share may have been deleted, with its cloud.
        audit(session, row.share_id or holder, "session.delete", holder)


def _ended() -> UnauthorizedError:
    return UnauthorizedError("The session has ended.", advice="Sign in again.")


def _holder(session: OrmSession, principal: Principal) -> ApiKey | Person | Share:
    """Return the one that asks. Raises UnauthorizedError where it has been deleted this moment."""
    found: ApiKey | Person | Share | None
    if principal.cloud_id is not None:
        found = session.get(Share, principal.key_id)
    else:
        found = session.get(Person, principal.key_id) if principal.is_person else session.get(ApiKey, principal.key_id)
    if found is None:
        raise _ended()
    return found


def _view(
    session: OrmSession, principal: Principal, holder: ApiKey | Person | Share, expires_at: datetime.datetime | None
) -> Session:
    query = sa.select(Project).where(Project.id.in_(principal.project_ids)).order_by(Project.name)
    projects = [SeenProject(id=row.id, name=row.name) for row in session.scalars(query)]
    first = projects[0] if projects else SeenProject(id="", name="")
    return Session(
        key_id=holder.id,
        name=pseudonym(holder.id) if isinstance(holder, Person) else holder.name,
        project_id=first.id,
        project=first.name,
        projects=projects,
        scopes=[scope for scope in SCOPES if scope in principal.scopes],
        roles=list(principal.roles),
        permissions=sorted(principal.permissions),
        expires_at=expires_at,
        cloud_id=principal.cloud_id,
    )


def set_cookie(response: Response, request: Request, settings: ServiceSettings, token: str, seconds: int) -> None:
    """Give the browser a session's token, or take it away with 0 ``seconds``."""
    response.headers["Cache-Control"] = "no-store"
    response.set_cookie(
        COOKIE,
        token,
        max_age=seconds,
        path="/",
        secure=over_tls(request, settings),
        httponly=True,
        samesite="strict",
    )


def over_tls(request: Request, settings: ServiceSettings) -> bool:
    """Return whether the browser speaks TLS, with the service or with a proxy before it.

    Whoever makes up the proxy's header only gets a cookie that plain HTTP does not send.
    """
    forwarded = request.headers.get("x-forwarded-proto", "").partition(",")[0].strip().lower()
    return "https" in (request.url.scheme, forwarded) or settings.public_url.lower().startswith("https://")

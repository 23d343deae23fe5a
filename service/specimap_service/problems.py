"""Errors as problem+json (RFC 9457): code, message, advice, and the correlation id for questions."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from specimap_core.errors import SpecimapError
from specimap_infra.database import database_errors
from specimap_infra.errors import DatabaseUnavailableError, StorageUnavailableError
from specimap_infra.logs import logger
from specimap_service.context import correlation_id
from specimap_service.errors import IdentityUnavailableError, RateLimitedError, RequestInvalidError, UnauthorizedError
from specimap_service.http_status import error_class, status_of

AWAY = (DatabaseUnavailableError, IdentityUnavailableError, StorageUnavailableError)
RETRY_AFTER_SECONDS = "5"
MEDIA_TYPE = "application/problem+json"
CLIENT_CLOSED = 499
ADVICE = {409: "Ask for the offset with HEAD, and continue from there."}
"""For statuses that the tus library answers with."""


class Problem(BaseModel):
    """The body of every error answer."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "type": "urn:specimap:error:not_found",
                "title": "not_found",
                "status": 404,
                "code": "not_found",
                "detail": "There is no job job_01k0000000000000000000000.",
                "advice": "Check the id.",
                "details": {},
                "correlation_id": "5f0c2a9d8b7e4c31",
            }
        }
    )

    type: str = Field(description="URN of the error's kind.")
    title: str = Field(description="The code, again, as RFC 9457 wants a title.")
    status: int
    code: str = Field(description="Stable code; docs/errors.md lists all.")
    detail: str = Field(description="What is wrong, in a sentence.")
    advice: str = Field(description="What to do.")
    details: dict[str, Any] = Field(description="Values that a program can use.")
    correlation_id: str = Field(description="Stands in the service's log lines of the same request.")


RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"description": "Refused", "model": Problem, "content": {MEDIA_TYPE: {}}},
    "5XX": {"description": "Failed", "model": Problem, "content": {MEDIA_TYPE: {}}},
}
"""Error answers in each operation's documentation."""


def problem_response(error: SpecimapError, status: int | None = None, **headers: str) -> JSONResponse:
    """Make the answer to an error."""
    status = status or status_of(error)
    if isinstance(error, RateLimitedError) or "retry_after_s" in error.details:
        headers["Retry-After"] = str(error.details.get("retry_after_s", 1))
    elif isinstance(error, AWAY):
        headers["Retry-After"] = RETRY_AFTER_SECONDS
    if isinstance(error, UnauthorizedError):
        headers["WWW-Authenticate"] = "Bearer"
    body = Problem(
        type=f"urn:specimap:error:{error.code}",
        title=error.code,
        status=status,
        code=error.code,
        detail=error.message,
        advice=error.advice,
        details=error.details,
        correlation_id=correlation_id(),
    )
    return JSONResponse(body.model_dump(mode="json"), status, headers, MEDIA_TYPE)


def add_handlers(app: FastAPI) -> None:
    """Answer every error of the app with a problem."""

    @app.exception_handler(SpecimapError)
    async def _known(request: Request, error: SpecimapError) -> JSONResponse:
        if isinstance(error, AWAY):
            # The log tells once that they are away, and why; a traceback of each request would bury that.
            logger().warning("request refused", code=error.code)
        elif status_of(error) >= 500:
            logger().error("request failed", code=error.code, exc_info=error)
        return problem_response(error)

    @app.exception_handler(SQLAlchemyError)
    async def _database(request: Request, error: SQLAlchemyError) -> Response:
        """Answer errors of the job engine's own transactions as those of ours."""
        try:
            with database_errors():
                raise error
        except DatabaseUnavailableError as away:
            return await _known(request, away)

    @app.exception_handler(RequestValidationError)
    async def _invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        fields = [{"where": ".".join(str(part) for part in e["loc"]), "what": e["msg"]} for e in error.errors()[:20]]
        first = fields[0] if fields else {"where": "body", "what": "does not read"}
        return problem_response(
            RequestInvalidError(
                f"{first['where']}: {first['what']}.", advice="Correct the request; /docs shows it.", fields=fields
            )
        )

    @app.exception_handler(ClientDisconnect)
    async def _gone(request: Request, error: ClientDisconnect) -> Response:
        # Read by nobody; the log shows the status, which is the usual one for this, instead of a failure.
        return Response(status_code=CLIENT_CLOSED)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        leaf = error_class(error.status_code)
        return problem_response(
            leaf(str(error.detail) + ".", advice=ADVICE.get(error.status_code, "/docs shows what there is.")),
            error.status_code,
            **(dict(error.headers) if error.headers else {}),
        )

"""Plain ASGI middleware: correlation id, access log, audit trail, metrics, headers for browsers, and the answer to
unforeseen errors."""

from __future__ import annotations

import re
import secrets
import time

import structlog
from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specimap_core.errors import SpecimapError
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger
from specimap_service.audit_note import NOTE, AuditNote
from specimap_service.audit_requests import access_of, is_audited
from specimap_service.audit_trail import AuditTrail
from specimap_service.context import ANSWER_HEADERS
from specimap_service.metrics import Metrics
from specimap_service.problems import problem_response
from specimap_service.security_headers import add_security_headers

HEADER = b"x-correlation-id"
ACCEPTED = re.compile(rb"^[A-Za-z0-9._-]{8,64}$")
QUIET = ("/healthz", "/readyz", "/metrics")


class RequestObserver:
    """Middleware that gives each request a correlation id, logs and counts it, and answers unforeseen errors.

    It logs no address, key or uploaded name.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics, trail: AuditTrail, public_url: str = "") -> None:
        self._app = app
        self._metrics = metrics
        self._trail = trail
        self._public_url = public_url

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(HEADER, b"")
        correlation = given.decode() if ACCEPTED.match(given) else secrets.token_hex(8)
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(correlation_id=correlation)
        more: dict[str, str] = {}
        scope[ANSWER_HEADERS] = more
        audited = is_audited(scope)
        note = AuditNote(address=self._trail.addresses.of(scope["client"][0]) if audited and scope["client"] else "")
        NOTE.set(note)
        start, status = time.perf_counter(), 0

        async def observed_send(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                if audited and (access := access_of(scope, note, status)) is not None:
                    # Before the first byte of the answer.
                    self._trail.record(access, correlation)
                given_headers = MutableHeaders(raw=list(message.get("headers", [])))
                add_security_headers(given_headers, scope["path"], self._public_url)
                message["headers"] = [
                    *given_headers.raw,
                    (HEADER, correlation.encode()),
                    *((name.lower().encode(), value.encode()) for name, value in more.items()),
                ]
            await send(message)

        try:
            if audited:
                await self._trail.room()
            await self._app(scope, receive, observed_send)
        except DatabaseUnavailableError as away:
            if status:
                raise
            await problem_response(away)(scope, receive, observed_send)
        except Exception:
            logger().exception("unforeseen error")
            if status:  # the answer has begun; cutting it off is all that is left
                raise
            error = SpecimapError("An error that Specimap does not know.", advice="Report it with the correlation id.")
            await problem_response(error)(scope, receive, observed_send)
        finally:
            seconds = time.perf_counter() - start
            route = getattr(scope.get("route"), "path", None) or "unmatched"
            self._metrics.observe_request(scope["method"], route, status, seconds)
            log = logger().debug if scope["path"] in QUIET else logger().info
            log("request", method=scope["method"], route=route, status=status, seconds=round(seconds, 4))

"""Requests: the key, correlation ids, retries, and answers turned into values or errors. Safe to share by threads."""

from __future__ import annotations

import re
import ssl
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from urllib.parse import quote

import httpx

from specimap_client import _retries
from specimap_client._errors import (
    ApiError,
    ConnectionFailed,
    NotConfigured,
    RateLimited,
    SpecimapClientError,
    Timeout,
    UnexpectedAnswer,
    leaf_of,
)
from specimap_client._retries import IDEMPOTENT, RATE_LIMITED, TRANSIENT, Retries, seconds_of
from specimap_client._version import __version__

JSON = "application/json"
_UNSENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)
_PRINTABLE = re.compile(r"[\x21-\x7e]+")
_CORRELATION = re.compile(r"[A-Za-z0-9._-]{8,64}")


def path(*parts: str | int) -> str:
    """An address within the service; names in it cannot leave their place."""
    return "v1/" + "/".join(quote(str(part), safe="") for part in parts)


class Session:
    """One connection pool to one service, with one key."""

    def __init__(
        self,
        url: str,
        key: str | None,
        *,
        timeout: httpx.Timeout | float,
        retries: Retries,
        transport: httpx.BaseTransport | None,
        verify: ssl.SSLContext | bool,
        correlation_id: str | None,
    ) -> None:
        # Checked here, since the libraries below quote a wrong header in their errors.
        if key is not None and not _PRINTABLE.fullmatch(key):
            raise NotConfigured("The key holds a character that no key has.")
        if correlation_id is not None and not _CORRELATION.fullmatch(correlation_id):
            raise NotConfigured("A correlation id has 8 to 64 letters, digits, dots, hyphens and underscores.")
        self.url = _checked(url)
        self.retries = retries
        self._fixed = correlation_id
        self.correlation_id = correlation_id or ""
        headers = {"User-Agent": f"specimap-client/{__version__} httpx/{httpx.__version__}"}
        if key is not None:
            headers["Authorization"] = f"Bearer {key}"
        self._http = httpx.Client(
            base_url=self.url, headers=headers, timeout=timeout, transport=transport, verify=verify
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def request(
        self,
        method: str,
        address: str,
        *,
        params: Mapping[str, Any] | None = None,
        json: object = None,
        content: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        safe: bool = False,
        once: bool = False,
    ) -> httpx.Response:
        """An answer below 300, read completely; or 304.

        Repeated are methods that may be, whatever carries an ``Idempotency-Key``, and what is said to be ``safe``;
        others only where the request was not taken: not sent, or refused by the rate limit. ``once``: never.

        Raises:
            ApiError, ConnectionFailed, Timeout, UnexpectedAnswer
        """
        given = {k: v for k, v in (params or {}).items() if v is not None}
        request = self._http.build_request(
            method, address, params=given or None, json=json, content=content, headers=self._with_id(headers)
        )
        safe = safe or method in IDEMPOTENT or "idempotency-key" in request.headers
        attempts = 1 if once else self.retries.attempts
        maybe_done = False
        for attempt in range(attempts):
            wait: float | None = None
            try:
                response = self._http.send(request)
            except httpx.RequestError as error:
                unsent = isinstance(error, _UNSENT)
                if attempt + 1 == attempts or _hopeless(error) or not (safe or unsent):
                    raise _translated(error, self.url) from error
                maybe_done = maybe_done or not unsent
            else:
                # httpx ties an answer and its stream to each other, and both keep the request's bytes until the next
                # garbage collection: hundreds of megabytes of an upload.
                response.stream = httpx.ByteStream(b"")
                self._note(response)
                if response.status_code < 300 or response.status_code == 304:
                    return response
                if method == "DELETE" and response.status_code == 404 and maybe_done:
                    return response  # an attempt before had deleted it, and its answer was lost
                problem = error_of(response)
                limited = response.status_code == RATE_LIMITED
                wait = seconds_of(response.headers.get("Retry-After"))
                if (
                    attempt + 1 == attempts
                    or not (limited or (safe and response.status_code in TRANSIENT))
                    or (wait is not None and wait > self.retries.longest_s)
                ):
                    raise problem
                maybe_done = maybe_done or not limited
            _retries.sleep(self.retries.delay(attempt, wait))
        raise AssertionError("Retries.attempts is at least 1")

    def create(self, address: str, body: Any) -> Any:
        """The JSON value of what a POST makes, once, however often the request has to be repeated.

        Raises as :meth:`request` does.
        """
        return self.json("POST", address, json=body, headers={"Idempotency-Key": str(uuid.uuid4())})

    def json(self, method: str, address: str, **options: Any) -> Any:
        """The JSON value of an answer. Raises as :meth:`request` does."""
        return json_of(self.request(method, address, **options))

    def pages(self, address: str, **params: Any) -> Iterator[Any]:
        """The items of all pages of a list, each page asked for when it is reached."""
        after = None
        while True:
            page = self.json("GET", address, params={**params, "after": after})
            try:
                items, after = page["items"], page["next"]
            except (TypeError, KeyError) as error:
                raise UnexpectedAnswer(f"{address}: the answer is no page of a list.") from error
            yield from items
            if after is None:
                return

    @contextmanager
    def stream(
        self,
        address: str,
        *,
        headers: Mapping[str, str] | None = None,
        params: Mapping[str, Any] | None = None,
        timeout: float | None = None,
    ) -> Iterator[httpx.Response]:
        """An answer below 300 to a GET, not read yet; one attempt. 416 is passed on too.

        Raises:
            ApiError, ConnectionFailed, Timeout, UnexpectedAnswer: also while it is read.
        """
        options: dict[str, Any] = {} if timeout is None else {"timeout": httpx.Timeout(timeout)}
        try:
            with self._http.stream("GET", address, params=params, headers=self._with_id(headers), **options) as answer:
                self._note(answer)
                if answer.status_code >= 300 and answer.status_code != 416:
                    answer.read()
                    raise error_of(answer)
                yield answer
        except httpx.RequestError as error:
            raise _translated(error, self.url) from error

    def _with_id(self, headers: Mapping[str, str] | None) -> dict[str, str]:
        return {"X-Correlation-Id": self._fixed or uuid.uuid4().hex, **(headers or {})}

    def _note(self, response: httpx.Response) -> None:
        self.correlation_id = response.headers.get("X-Correlation-Id") or response.request.headers["X-Correlation-Id"]


def json_of(response: httpx.Response) -> Any:
    """The JSON value of an answer.

    Raises:
        UnexpectedAnswer: it is none.
    """
    try:
        return response.json()
    except ValueError as error:
        kind = response.headers.get("Content-Type", "nothing")
        raise UnexpectedAnswer(f"{response.request.url.path} answered with {kind}, not with JSON.") from error


def error_of(response: httpx.Response) -> SpecimapClientError:
    """The error that an answer of 300 or more, read completely, stands for."""
    status = response.status_code
    if status < 400:
        target = response.headers.get("Location", "elsewhere")
        return UnexpectedAnswer(f"{response.request.url.path} leads to {target}. Give the service's own address.")
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict) or "code" not in body:
        # A proxy in between speaks for itself.
        body = {"code": f"http_{status}", "detail": response.reason_phrase or "The request was refused."}
    correlation = body.get("correlation_id") or response.headers.get("X-Correlation-Id", "")
    details = body.get("details")
    error: ApiError = leaf_of(status)(
        str(body["code"]),
        str(body.get("detail") or ""),
        str(body.get("advice") or ""),
        details if isinstance(details, dict) else {},
        status,
        str(correlation),
    )
    if isinstance(error, RateLimited):
        error.retry_after = seconds_of(response.headers.get("Retry-After"))
    return error


def _translated(error: httpx.RequestError, url: str) -> SpecimapClientError:
    if isinstance(error, httpx.TimeoutException):
        return Timeout(f"{url} did not answer in time ({type(error).__name__}).")
    return ConnectionFailed(f"The connection to {url} failed: {error or type(error).__name__}.")


def _hopeless(error: BaseException) -> bool:
    """Whether the same request will fail in the same way: it is not one, or the certificate is not trusted."""
    if not isinstance(error, httpx.TransportError) or isinstance(
        error, httpx.UnsupportedProtocol | httpx.LocalProtocolError
    ):
        return True
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


def _checked(url: str) -> str:
    try:
        parsed = httpx.URL(url.strip())
    except httpx.InvalidURL as error:
        raise NotConfigured("The address is no URL.") from error
    if parsed.scheme not in ("http", "https") or not parsed.host or parsed.userinfo or parsed.query or parsed.fragment:
        raise NotConfigured("The address must look like https://specimap.example, without user, query and fragment.")
    return str(parsed).rstrip("/")

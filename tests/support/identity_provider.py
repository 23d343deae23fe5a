"""An identity provider for tests, on loopback: it signs what it is told to, and misbehaves on request."""

from __future__ import annotations

import json
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import httpx
from authlib.oauth2.rfc7636 import create_s256_code_challenge
from joserfc import jws
from joserfc.jwk import RSAKey

from tests.support.plain_http import NO_TLS

CLIENT_ID, CLIENT_SECRET, AUDIENCE = "specimap", "a secret of the client", "https://specimap.test/api"
ROLES = {f"specimap-{role}": role for role in ("technician", "clinician", "classifier", "admin", "auditor")}


@dataclass
class Provider:
    """A provider at ``issuer``. Its attributes say what it answers; ``asked`` counts requests by path."""

    issuer: str = ""
    keys: list[RSAKey] = field(default_factory=lambda: [RSAKey.generate_key(2048, {"kid": "first", "use": "sig"})])
    metadata: dict[str, Any] = field(default_factory=dict)
    """In place of, or beside, what it says of itself; None takes something away."""
    account: dict[str, Any] = field(default_factory=lambda: {"sub": "alice", "roles": ["specimap-technician"]})
    """Claims of the one who signs in."""
    userinfo: dict[str, Any] = field(default_factory=dict)
    id_token: dict[str, Any] = field(default_factory=dict)
    """In place of claims of the ID token."""
    answer: dict[str, str] = field(default_factory=dict)
    """In place of parameters with which it sends a browser back."""
    away: bool = False
    asked: dict[str, int] = field(default_factory=dict)
    codes: dict[str, dict[str, str]] = field(default_factory=dict)

    def description(self) -> dict[str, Any]:
        """What it says of itself."""
        own = {
            "issuer": self.issuer,
            "authorization_endpoint": f"{self.issuer}/authorize",
            "token_endpoint": f"{self.issuer}/token",
            "userinfo_endpoint": f"{self.issuer}/userinfo",
            "jwks_uri": f"{self.issuer}/keys",
            "end_session_endpoint": f"{self.issuer}/end",
        }
        return {name: value for name, value in {**own, **self.metadata}.items() if value is not None}

    def claims(self, **more: Any) -> dict[str, Any]:
        """Claims of an access token that counts; None takes one away."""
        now = int(time.time())
        own = {"iss": self.issuer, "aud": AUDIENCE, "iat": now, "exp": now + 300, **self.account, **more}
        return {name: value for name, value in own.items() if value is not None}

    def token(self, header: dict[str, Any] | None = None, key: RSAKey | None = None, **more: Any) -> str:
        """A signed access token."""
        key = key or self.keys[0]
        return signed({"alg": "RS256", "kid": key.kid, **(header or {})}, json.dumps(self.claims(**more)), key)

    def settings(self, public_url: str, **more: Any) -> dict[str, Any]:
        """Settings of a service that uses it."""
        own = {
            "oidc_issuer": self.issuer,
            "oidc_client_id": CLIENT_ID,
            "oidc_client_secret": CLIENT_SECRET,
            "oidc_audience": AUDIENCE,
            "oidc_roles": ROLES,
            "public_url": public_url,
        }
        return {**own, **more}

    # ---- endpoints ------------------------------------------------------------------------------------

    def authorize(self, given: dict[str, str]) -> str:
        """Where it sends a browser whose account is known: back with a code."""
        code = secrets.token_urlsafe(16)
        self.codes[code] = given
        back = {"code": code, "state": given["state"], **self.answer}
        return f"{given['redirect_uri']}?{urlencode({name: value for name, value in back.items() if value})}"

    def tokens(self, given: dict[str, str], authorization: str) -> tuple[int, dict[str, Any]]:
        """Its answer to a code, which counts once, for the client that has the verifier."""
        asked = self.codes.pop(given.get("code", ""), None)
        basic = httpx.BasicAuth(CLIENT_ID, CLIENT_SECRET)._auth_header
        if asked is None or authorization != basic or given["redirect_uri"] != asked["redirect_uri"]:
            return 400, {"error": "invalid_grant"}
        if create_s256_code_challenge(given["code_verifier"]) != asked["code_challenge"]:
            return 400, {"error": "invalid_grant"}
        own = self.claims(aud=CLIENT_ID, nonce=asked["nonce"]) | self.id_token
        claims = {name: value for name, value in own.items() if value is not None}
        header = {"alg": "RS256", "kid": self.keys[0].kid}
        return 200, {
            "access_token": self.token(),
            "token_type": "Bearer",
            "id_token": signed(header, json.dumps(claims), self.keys[0]),
        }


def signed(header: dict[str, Any], payload: str, key: Any, algorithms: tuple[str, ...] = ("RS256",)) -> str:
    """Any payload, signed."""
    registry = jws.JWSRegistry(algorithms=list(algorithms), strict_check_header=False)
    return jws.serialize_compact(header, payload, key, registry=registry)


class _Handler(BaseHTTPRequestHandler):
    provider: Provider

    def do_GET(self) -> None:
        path, provider = urlsplit(self.path), self.provider
        given = {name: values[0] for name, values in parse_qs(path.query).items()}
        provider.asked[path.path] = provider.asked.get(path.path, 0) + 1
        if provider.away:
            self._send(503, b"<html>away</html>")
        elif path.path == "/.well-known/openid-configuration":
            self._json(200, provider.description())
        elif path.path == "/keys":
            self._json(200, {"keys": [key.as_dict(private=False) for key in provider.keys]})
        elif path.path == "/authorize":
            self._send(302, b"", Location=provider.authorize(given))
        elif path.path == "/userinfo":
            self._json(200, {"sub": provider.account["sub"], **provider.userinfo})
        else:
            self._send(404, b"")

    def do_POST(self) -> None:
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        given = {name: values[0] for name, values in parse_qs(text).items()}
        if self.provider.away:
            self._send(503, b"<html>away</html>")
        else:
            self._json(*self.provider.tokens(given, self.headers.get("Authorization", "")))

    def _json(self, status: int, value: Any) -> None:
        self._send(status, json.dumps(value).encode())

    def _send(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@contextmanager
def provider_running() -> Iterator[Provider]:
    """Run a provider until the block ends."""
    provider = Provider()
    handler = type("Handler", (_Handler,), {"provider": provider})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    provider.issuer = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield provider
    finally:
        server.shutdown()
        server.server_close()
        thread.join(timeout=10)


def browser(url: str, **headers: str) -> httpx.Client:
    """A client that keeps cookies, follows nothing, and sends what the service's own pages send."""
    return httpx.Client(
        base_url=url, headers={"Specimap-Page": "1", **headers}, timeout=30, trust_env=False, verify=NO_TLS
    )

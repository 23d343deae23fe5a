"""Clients for tests: of a function that answers, where waits are only noted, and of a running service."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest

from specimap_client import Client, Cloud, Retries, _retries
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import ALL_SCOPES, Running, serving

KEY = "spk_01k00000000000000000000000_" + "5ec2e7" * 10
Handler = Callable[[httpx.Request], httpx.Response]


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that the client would have waited, in order; it does not wait."""
    noted: list[float] = []
    monkeypatch.setattr(_retries, "sleep", noted.append)
    return noted


def client_of(handler: Handler, **options: Any) -> Client:
    """A client whose requests the function answers."""
    given = {"retries": Retries(attempts=4), "transport": httpx.MockTransport(handler), **options}
    return Client("https://specimap.test/base", KEY, **given)


def problem(status: int, code: str, headers: dict[str, str] | None = None, **details: object) -> httpx.Response:
    """An error as the service answers it."""
    body = {
        "type": f"urn:specimap:error:{code}",
        "title": code,
        "status": status,
        "code": code,
        "detail": "It is so.",
        "advice": "Do otherwise.",
        "details": details,
        "correlation_id": "c0ffee00",
    }
    media = {"Content-Type": "application/problem+json"}
    return httpx.Response(status, headers=media | (headers or {}), content=json.dumps(body).encode())


def answers(*given: httpx.Response | Exception) -> tuple[Handler, list[httpx.Request]]:
    """A function that gives these answers one after the other, and the requests it saw."""
    seen: list[httpx.Request] = []
    left = iter(given)

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        answer = next(left)
        if isinstance(answer, Exception):
            raise answer
        return answer

    return handler, seen


@dataclass
class TusService:
    """The upload part of a service, with faults: ``faults`` are taken one for each PATCH.

    ``before``: the connection breaks before anything arrives; ``half``: after half of the chunk; ``after``: the answer
    is lost; ``garbled``: the checksum does not fit; ``503``.
    """

    faults: list[str] = field(default_factory=list)
    known: dict[str, bytearray] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    requests: list[tuple[str, int]] = field(default_factory=list)
    largest: int = 0
    verdict: dict[str, Any] = field(default_factory=lambda: {"verdict": "accepted"})

    def __call__(self, request: httpx.Request) -> httpx.Response:
        """Answer a request."""
        body = request.read()
        self.largest = max(self.largest, len(body))
        self.requests.append((request.method, len(body)))
        upload = request.url.path.removeprefix("/base/v1/uploads").strip("/").split("/")[0]
        if request.url.path.endswith("/result"):
            return self._result(upload)
        assert request.headers["Tus-Resumable"] == "1.0.0"
        if request.method == "POST":
            return self._create(request)
        if upload not in self.known:
            return problem(404, "not_found")
        if request.method == "HEAD":
            return httpx.Response(200, headers={"Upload-Offset": str(len(self.known[upload]))})
        return self._patch(request, upload, body)

    def _create(self, request: httpx.Request) -> httpx.Response:
        upload = f"up_{len(self.known):026d}"
        pairs = (pair.split(" ") for pair in request.headers["Upload-Metadata"].split(","))
        self.metadata[upload] = {name: base64.b64decode(value).decode() for name, value in pairs}
        self.known[upload], self.sizes[upload] = bytearray(), int(request.headers["Upload-Length"])
        # A proxy's idea of the address: the client must take no more than the id from it.
        return httpx.Response(201, headers={"Location": f"http://elsewhere.test/v1/uploads/{upload}"})

    def _patch(self, request: httpx.Request, upload: str, body: bytes) -> httpx.Response:
        fault = self.faults.pop(0) if self.faults else ""
        if fault == "before":
            raise httpx.WriteError("broken pipe", request=request)
        if fault == "503":
            return problem(503, "storage_unavailable")
        if int(request.headers["Upload-Offset"]) != len(self.known[upload]):
            return problem(409, "upload_conflict")
        assert request.headers["Content-Type"] == "application/offset+octet-stream"
        algorithm, digest = request.headers["Upload-Checksum"].split(" ")
        assert algorithm == "sha256"
        if fault == "garbled":
            return problem(460, "upload_conflict")
        assert base64.b64decode(digest) == hashlib.sha256(body).digest()
        if fault == "half":
            self.known[upload] += body[: len(body) // 2]
            raise httpx.ReadError("connection reset", request=request)
        self.known[upload] += body
        if fault == "after":
            raise httpx.RemoteProtocolError("server disconnected", request=request)
        return httpx.Response(204, headers={"Upload-Offset": str(len(self.known[upload]))})

    def _result(self, upload: str) -> httpx.Response:
        if upload not in self.known:
            return problem(404, "not_found")
        content, size = bytes(self.known[upload]), self.sizes[upload]
        state = "finished" if len(content) == size else "open"
        name = self.metadata[upload]["filename"]
        file = {
            "id": "file_1",
            "role": self.metadata[upload]["role"],
            "label": f"label-of-{name}",
            "name": name,
            "size": size,
            "sha256": hashlib.sha256(content).hexdigest(),
            "state": "accepted",
            "judgement": self.verdict,
            "created_at": "2026-11-22T06:00:00Z",
        }
        answer = {
            "id": upload,
            "state": state,
            "offset": len(content),
            "size": size,
            "error": None,
            "file": file if state == "finished" else None,
        }
        return httpx.Response(200, json=answer)


def sse(*events: tuple[int, str, dict[str, Any]]) -> Iterator[bytes]:
    """Events as bytes, with a comment before each."""
    for seq, kind, data in events:
        yield f": keep-alive\n\nevent: {kind}\nid: {seq}\ndata: {json.dumps(data)}\n\n".encode()


# ---- a running service -----------------------------------------------------------------------------


def connect(service: Running, scopes: Sequence[str] = ALL_SCOPES, **options: object) -> Client:
    """A client with a new key; its transport keeps this machine's proxies out."""
    return Client(service.url, service.key(scopes), transport=httpx.HTTPTransport(verify=NO_TLS), **options)  # type: ignore[arg-type]


@dataclass
class Live:
    """A service with one result."""

    service: Running
    client: Client
    result: Result

    @property
    def cloud(self) -> Cloud:
        return self.client.clouds.get(self.result.cloud_id)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    folder = tmp_path_factory.mktemp("live")
    with serving(folder / "service") as service, connect(service) as client:
        yield Live(service, client, put_result(service, folder / "result"))

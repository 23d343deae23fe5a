"""A server on loopback that takes FHIR transactions as the standard says: as a whole, with conditional requests."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote

Answer = tuple[int, dict[str, Any]]


class FhirServer:
    """Its store, by type; ``answers`` are given first, one for each request."""

    def __init__(self) -> None:
        self.store: dict[str, list[dict[str, Any]]] = {}
        self.answers: list[Answer | Callable[[], None]] = []
        self.requests: list[dict[str, str]] = []
        self.bundles: list[dict[str, Any]] = []
        self.tokens: list[str] = []
        self.url = ""

    def transaction(self, bundle: dict[str, Any]) -> Answer:
        """Create and replace; refuse everything where a condition fits several."""
        self.bundles.append(bundle)
        assert bundle["type"] == "transaction"
        assert len({entry["fullUrl"] for entry in bundle["entry"]}) == len(bundle["entry"])
        statuses = []
        for entry in bundle["entry"]:
            resource, request = entry["resource"], entry["request"]
            rows = self.store.setdefault(resource["resourceType"], [])
            query = request.get("ifNoneExist") or request["url"].partition("?")[2]
            system, _, value = parse_qs(query)["identifier"][0].partition("|")
            found = [index for index, row in enumerate(rows) if (system, value) in _identifiers(row)]
            if len(found) > 1:
                return 412, {"resourceType": "OperationOutcome", "issue": [{"code": "multiple-matches"}]}
            if not found:
                rows.append(resource)
                statuses.append("201 Created")
            elif request["method"] == "PUT":
                rows[found[0]] = resource
                statuses.append("200 OK")
            else:
                statuses.append("200 OK")
        return 200, {
            "resourceType": "Bundle",
            "type": "transaction-response",
            "entry": [{"response": {"status": status}} for status in statuses],
        }


def _identifiers(row: dict[str, Any]) -> set[tuple[str, str]]:
    return {(item.get("system", ""), item["value"]) for item in row["identifier"]}


@contextmanager
def fhir_server() -> Iterator[FhirServer]:
    """Run a server until the block ends."""
    server = FhirServer()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            server.requests.append({"path": self.path, **dict(self.headers.items())})
            if self.path == "/token":
                server.tokens.append(unquote(body.decode()))
                self._answer(200, {"access_token": f"token-{len(server.tokens)}", "expires_in": 3600})
                return
            given = server.answers.pop(0) if server.answers else None
            if callable(given):
                given()
                return
            self._answer(*(given or server.transaction(json.loads(body))))

        def _answer(self, status: int, content: dict[str, Any]) -> None:
            body = json.dumps(content).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/fhir+json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.url = f"http://127.0.0.1:{httpd.server_address[1]}"
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        httpd.shutdown()
        httpd.server_close()
        thread.join(timeout=10)

"""Bodies of requests: none is read before the key is known, and none beyond the limit of its kind."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from specimap_service.body_limits import FILES, LARGEST_JSON, LARGEST_SELECTION, SELECTIONS, most_bytes
from specimap_service.uploads.multipart import LONGEST_HEADER, MOST_HEADERS, MOST_OVERHEAD
from tests.support.places import SAMPLES
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import client_at, key_in, new_acquisition, process_serving

CLOUD = f"/v1/clouds/cloud_{'0' * 26}/spectra"
KINDS = ("application/octet-stream", "application/json", "multipart/form-data; boundary=b", "text/plain", "")
SIGN_IN = ("POST", "/v1/session")
OF_PATHS = {
    "acquisition_id": f"acq_{'0' * 26}",
    "file_id": f"file_{'0' * 26}",
    "job_id": f"job_{'0' * 26}",
    "cloud_id": f"cloud_{'0' * 26}",
    "key_id": f"key_{'0' * 26}",
    "project_id": f"prj_{'0' * 26}",
    "share_id": f"shr_{'0' * 26}",
    "upload_id": f"up_{'0' * 26}",
    "uuid": f"up_{'0' * 26}",
    "name": "layer",
    "format": "ply",
}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("bodies"), rate_per_minute=10**6) as running:
        yield running


def routes(service: Running) -> list[tuple[str, str]]:
    """Method and address of all that may have a body, and of some that do not exist."""
    found = [
        (method.upper(), re.sub(r"\{(\w+)\}", lambda name: OF_PATHS[name[1]], path))
        for path, operations in service.app.openapi()["paths"].items()
        for method in operations
        if method in ("post", "put", "patch", "delete")
    ]
    assert len(found) >= 14
    strange = [("POST", "/v1/uploads/"), ("POST", "/"), ("PUT", "/docs"), ("POST", "/healthz"), ("POST", "/v1/none")]
    return [*found, *strange]


def asked(
    service: Running,
    method: str,
    path: str,
    *,
    key: str = "",
    kind: str = KINDS[0],
    size: int | None = None,
    body: bytes = b"",
    page: bool = False,
) -> tuple[int, dict[str, Any], bytes]:
    """The answer to a request of which ``body`` alone is sent, though it says ``size`` bytes (None: in chunks).

    ``page``: as the service's own pages ask.
    """
    url = httpx.URL(service.url)
    lines = [f"{method} {path} HTTP/1.1", "Host: x", "Tus-Resumable: 1.0.0"]
    lines += [f"Content-Type: {kind}"] if kind else []
    lines += [f"Authorization: Bearer {key}"] if key else []
    lines += ["Specimap-Page: 1"] if page else []
    lines.append("Transfer-Encoding: chunked" if size is None else f"Content-Length: {size}")
    with socket.create_connection((url.host, url.port or 80), timeout=30) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        if body:
            connection.sendall(body if size is not None else f"{len(body):x}\r\n".encode() + body + b"\r\n")
        with connection.makefile("rb") as reader:
            status = int(reader.readline().split()[1])
            headers = {}
            while line := reader.readline().strip():
                name, _, value = line.partition(b":")
                headers[name.decode().lower()] = value.strip().decode()
            text = reader.read(int(headers.get("content-length", 0)))
    return status, headers, text


def code(text: bytes) -> str:
    return str(json.loads(text)["code"])


@pytest.mark.parametrize("size", [1_500_000_000, None])
@pytest.mark.parametrize("key", ["", "wrong"])
def test_without_a_key_no_byte_is_waited_for(shared: Running, size: int | None, key: str) -> None:
    seen = set()
    for method, path in routes(shared):
        for kind in KINDS:
            status, headers, text = asked(shared, method, path, kind=kind, size=size, key=key)
            if (method, path) == SIGN_IN:
                # Its body holds the key; what is no page of the service is refused before.
                assert (status, code(text)) == (403, "cross_site_request"), kind
                continue
            seen.add((status, code(text)))
            assert status in (401, 429), f"{method} {path} {kind}"
            assert headers["content-type"] == "application/problem+json"
            assert status == 429 or headers["www-authenticate"] == "Bearer"
    # Wrong keys are counted, so that they cannot be guessed.
    assert seen <= {(401, "unauthorized"), (429, "rate_limited")}
    assert ((429, "rate_limited") in seen) == bool(key)


def test_a_body_that_says_it_is_too_large_is_not_read(shared: Running) -> None:
    key = shared.key()
    for method, path in routes(shared):
        limit = most_bytes(method, path)
        if limit is None:
            continue
        for kind in KINDS:
            status, _, text = asked(shared, method, path, kind=kind, size=limit + 1, key=key, page=True)
            assert (status, code(text)) == (413, "payload_too_large"), f"{method} {path} {kind}"
            assert json.loads(text)["details"] == {"limit_bytes": limit}


def test_a_body_that_says_nothing_is_cut_off(shared: Running) -> None:
    key = shared.key()
    reads = [("POST", "/v1/jobs"), ("POST", "/v1/acquisitions"), ("POST", "/v1/keys"), ("POST", CLOUD)]
    for method, path in reads:
        limit = most_bytes(method, path)
        assert limit is not None
        for kind in KINDS[:2]:
            status, _, text = asked(shared, method, path, kind=kind, size=None, key=key, body=b" " * (limit + 1))
            assert (status, code(text)) == (413, "payload_too_large"), f"{method} {path} {kind}"


BODIES = {
    "deep": b"[" * 50_000,
    "deeper": b'{"a":' * 900 + b"1" + b"}" * 900,
    "nothing": b"",
    "null": b"null",
    "text": b"\xff\xfe{",
    "number": b"1e999",
    "list": b"[]",
    "names": b"{" + b",".join(b'"a%d":1' % i for i in range(4000)) + b"}",
    "numbers": b'{"scopes":[' + b"1," * 20_000 + b"1]}",
    "surrogate": b'{"specimen_id":"\\ud800","name":"\\ud800"}',
    "nan": b'{"edge_mm":NaN,"priority":NaN}',
    "huge": b'{"priority":' + b"9" * 30_000 + b"}",
}


@pytest.mark.slow
def test_no_body_makes_a_route_fail(shared: Running) -> None:
    headers = {"Authorization": f"Bearer {shared.key()}", "Tus-Resumable": "1.0.0"}
    with httpx.Client(base_url=shared.url, headers=headers, trust_env=False, verify=NO_TLS, timeout=60) as client:
        for method, path in routes(shared):
            for name, body in BODIES.items():
                for kind in KINDS:
                    own = {"Content-Type": kind} if kind else {}
                    answer = client.request(method, path, content=body, headers=own)
                    assert answer.status_code < 500, f"{method} {path} {name} {kind}: {answer.text[:200]}"
        assert client.get("/readyz").status_code == 200


def test_files_alone_have_limits_of_their_own(shared: Running) -> None:
    found = routes(shared)
    for known in (*FILES, *SELECTIONS):
        assert [1 for method, path in found if method == known[0] and known[1].fullmatch(path)], known
    limits = {most_bytes(method, path) for method, path in found}
    assert limits == {None, LARGEST_JSON, LARGEST_SELECTION, most_bytes(*SIGN_IN)}
    assert most_bytes(*SIGN_IN) == 4096
    # FastAPI reads a body that a route names; those of files read it themselves.
    operations = shared.app.openapi()["paths"]
    for path, of_path in operations.items():
        for method, operation in of_path.items():
            content = operation.get("requestBody", {}).get("content", {})
            if most_bytes(method.upper(), path) is None and method in ("post", "put", "patch"):
                assert "application/json" not in content, path


@pytest.mark.slow
@pytest.mark.parametrize("chunked", [False, True])
def test_memory_stays_while_a_stranger_sends(tmp_path: Path, chunked: bool) -> None:
    key = key_in(tmp_path)
    with process_serving(tmp_path) as (process, url), client_at(url, key) as client:
        assert client.get("/v1/jobs").status_code == 200

        def peak() -> int:
            (line,) = re.findall(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{process.pid}/status").read_text())
            return int(line) * 1024

        before, total = peak(), 96 * 1024**2
        pieces = (b"x" * 65536 for _ in range(total // 65536))
        headers = {"Content-Type": "application/octet-stream"} | ({} if chunked else {"Content-Length": str(total)})
        answer = httpx.post(
            f"{url}/v1/jobs", content=pieces, headers=headers, trust_env=False, verify=NO_TLS, timeout=60
        )
        assert answer.status_code == 401
        assert peak() - before < total / 4


# ---- selections, which may be large --------------------------------------------------------------------


def test_a_large_selection_is_read_and_a_wrong_one_is_told_of_once(shared: Running) -> None:
    client = shared.client()

    def posted(document: str) -> httpx.Response:
        return client.post(CLOUD, content=document, headers={"Content-Type": "application/json"})

    bands = list(range(4_000_000_000, 4_000_000_000 + 65536))
    full = json.dumps({"select": {"pixels": [[65535, 65535]] * 100_000}, "bands": {"indices": bands}})
    assert len(full) < LARGEST_SELECTION
    assert posted(full).status_code == 404
    wrong = posted(json.dumps({"select": {"pixels": [["a", 0.5]] * 100_000}}))
    assert (wrong.status_code, wrong.json()["code"]) == (422, "request_invalid")
    assert wrong.json()["details"]["fields"][0]["where"] == "body.select.pixels.0.0"
    assert len(wrong.json()["details"]["fields"]) <= 2
    strange = posted("{" + ",".join(f'"k{i}":1' for i in range(300_000)) + "}")
    assert (strange.status_code, strange.json()["code"]) == (422, "request_invalid")
    missing = posted("{}").json()["details"]["fields"]
    assert missing == [{"where": "body.select", "what": "Field required"}]
    assert posted('{"select":').status_code == 422


# ---- forms ---------------------------------------------------------------------------------------------


def form(*parts: bytes) -> bytes:
    return b"".join(b"--b\r\n" + part + b"\r\n" for part in parts) + b"--b--\r\n"


ROLE = b'Content-Disposition: form-data; name="role"\r\n\r\nphoto'
FILE = b'Content-Disposition: form-data; name="file"; filename="x.jpg"\r\n\r\nnot a photo'


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (form(ROLE, FILE), 201),
        (form(ROLE, b"X-Long: " + b"x" * LONGEST_HEADER + b"\r\n" + FILE), 422),
        (form(ROLE, b"X" * LONGEST_HEADER + b"XX: y\r\n" + FILE), 422),
        (form(ROLE, b"X-Many: y\r\n" * (MOST_HEADERS + 1) + FILE), 422),
        (form(ROLE, *[ROLE] * (MOST_OVERHEAD // 50), FILE), 413),
        (b"x" * 2 * MOST_OVERHEAD, 422),
        (form(ROLE, FILE) + b"x" * 2 * MOST_OVERHEAD, 413),
    ],
    ids=["good", "long header", "long name", "many headers", "many parts", "before", "after"],
)
def test_forms_hold_little_beside_their_files(shared: Running, body: bytes, status: int) -> None:
    client = shared.client()
    acquisition = new_acquisition(client)
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    answer = client.post(f"/v1/acquisitions/{acquisition}/files", content=body, headers=headers)
    assert answer.status_code == status, answer.text[:300]
    scratch = shared.settings.scratch / "uploads"
    assert not list(scratch.glob("*.part"))


def test_a_large_file_needs_no_more_than_its_own_bytes(shared: Running) -> None:
    client = shared.client()
    data = (SAMPLES / "hsi" / "hsi.raw").read_bytes()
    assert len(data) > 2 * MOST_OVERHEAD
    answer = client.post(
        f"/v1/acquisitions/{new_acquisition(client)}/files", data={"role": "cube"}, files={"file": ("x.raw", data)}
    )
    assert answer.status_code == 201


# ---- the order of things -------------------------------------------------------------------------------


def test_a_page_of_another_origin_reads_the_refusals(tmp_path: Path) -> None:
    with serving(tmp_path, cors_origins=["https://tablet.example"]) as service:
        origin = {"Origin": "https://tablet.example"}
        asking = {**origin, "Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization"}
        with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as stranger:
            assert stranger.options("/v1/jobs", headers=asking).status_code == 200
            refused = stranger.post("/v1/jobs", headers=origin, json={})
        assert refused.status_code == 401
        assert refused.headers["access-control-allow-origin"] == "https://tablet.example"
        large = service.client().post("/v1/jobs", headers=origin, content=b" " * (LARGEST_JSON + 1))
        assert large.status_code == 413
        assert large.headers["access-control-allow-origin"] == "https://tablet.example"
        assert large.headers["x-correlation-id"] == large.json()["correlation_id"]


def test_a_request_with_a_body_counts_once(tmp_path: Path) -> None:
    with serving(tmp_path) as service:
        client = service.client(rate_per_minute=4)
        answers = [client.post("/v1/acquisitions", json={"specimen_id": "A"}).status_code for _ in range(6)]
        assert answers[:4] == [201] * 4
        assert 429 in answers[4:]

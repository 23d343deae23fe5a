"""Headers that every answer carries, whatever made it: routes, refusals, pages, files, uploads, the server itself."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from tests.support.places import SAMPLES
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import Running, serving

YEAR = "max-age=31536000"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service behind a TLS proxy, with pages."""
    pages = tmp_path_factory.mktemp("pages")
    (pages / "index.html").write_text("<!doctype html><title>Specimap</title>", "utf-8")
    with serving(tmp_path_factory.mktemp("data"), pages=pages, public_url="https://specimap.example") as service:
        yield service


def check(headers: httpx.Headers, where: str, *, tls: bool = True) -> None:
    for name in ("x-content-type-options", "referrer-policy", "cache-control", "content-security-policy"):
        assert len(headers.get_list(name)) == 1, f"{where}: {name}"
    assert headers["x-content-type-options"] == "nosniff", where
    assert headers["referrer-policy"] == "no-referrer", where
    policy = headers["content-security-policy"].split("; ")
    assert {"default-src 'none'", "frame-ancestors 'none'"} <= set(policy), where
    assert headers.get_list("strict-transport-security") == ([YEAR] if tls else []), where
    # Nothing that is shown to one person is kept where another finds it.
    assert "public" not in headers["cache-control"] or "/assets/" in where or where == "GET /", where
    assert "server" not in headers, where


def test_every_kind_of_answer_carries_them(site: Running, tmp_path: Path) -> None:
    client = site.client()
    result = put_result(site, tmp_path / "result")
    put_label(site, result, "tissue", np.zeros(result.cloud.n_points, np.float32))
    cloud = f"/v1/clouds/{result.cloud_id}"
    photo = sorted((SAMPLES / "rgb").glob("*.jpg"))[0]
    made = client.post("/v1/acquisitions", json={"specimen_id": "S-1", "edge_mm": 6.8})
    acquisition = made.json()["id"]
    asked = [
        made,
        client.post(
            f"/v1/acquisitions/{acquisition}/files", files={"file": photo.read_bytes()}, data={"role": "photo"}
        ),
        client.options("/v1/uploads", headers={"Tus-Resumable": "1.0.0"}),
        client.post("/v1/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "9"}),
        *(client.get(f"{cloud}/{path}") for path in ("zarr/zarr.json", "zarr/labels/tissue/zarr.json", "points/17")),
        client.get(f"{cloud}/zarr/xyz/c/0/0", headers={"Range": "bytes=0-9"}),
        client.get(f"{cloud}/zarr/xyz/c/0/0", headers={"Range": "bytes=99999999-"}),
        client.get(f"{cloud}/previews/rgb.png"),
        client.head(f"{cloud}/zarr/zarr.json"),
        *(client.get(path) for path in ("/", "/healthz", "/readyz", "/metrics", "/docs", "/v1/jobs", "/openapi.json")),
        *(client.get(path) for path in ("/v1/nowhere", "/nowhere.html", "/v1/jobs?limit=x", "/v1/jobs/job_1")),
        client.request("PATCH", "/v1/jobs"),
        client.post("/v1/jobs", content=b"{", headers={"Content-Type": "application/json"}),
        client.post("/v1/jobs", content=b"x" * 2_000_000, headers={"Content-Type": "application/json"}),
        httpx.get(f"{site.url}/v1/jobs", trust_env=False, verify=NO_TLS),
        httpx.get(f"{site.url}/v1/jobs", headers={"Authorization": "Bearer spk_x"}, trust_env=False, verify=NO_TLS),
    ]
    assert {answer.status_code for answer in asked} >= {200, 201, 206, 401, 404, 405, 413, 416, 422}
    for answer in asked:
        check(answer.headers, f"{answer.request.method} {answer.request.url.path}")


def test_an_unforeseen_fault_carries_them(site: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    client = site.client()
    client.get("/v1/jobs")

    def fail(*_: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr(site.app.state.context.metrics, "text", fail)
    answer = client.get("/metrics")
    assert answer.status_code == 500
    assert answer.json()["code"] == "internal_error"
    assert "unforeseen" not in answer.text
    check(answer.headers, "a fault")


def test_without_tls_nobody_is_told_to_use_it(tmp_path: Path) -> None:
    with serving(tmp_path) as service:
        check(service.client().get("/v1/jobs").headers, "plain", tls=False)


def test_what_the_server_itself_refuses_can_run_nothing(tmp_path: Path) -> None:
    with serving(tmp_path, silence_seconds=0.4) as service:
        place, key = httpx.URL(service.url), service.client().headers["Authorization"]
        asked = f"POST /v1/acquisitions HTTP/1.1\r\nHost: x\r\nAuthorization: {key}\r\nContent-Length: 9000\r\n"
        with socket.create_connection((place.host, place.port or 80), timeout=20) as connection:
            connection.sendall(f"{asked}Content-Type: application/json\r\n\r\n{{".encode())
            head = connection.recv(4000).decode().lower()
    assert head.startswith("http/1.1 408")
    assert "x-content-type-options: nosniff" in head
    assert "content-security-policy: default-src 'none'; frame-ancestors 'none'; sandbox" in head

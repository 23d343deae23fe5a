"""The contract: the document is what the app serves, and the app keeps it under generated requests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from specimap_service.openapi import document
from tests.support.places import ROOT, SUPPORT
from tests.support.result_scene import put_result
from tests.support.service_scene import Running

EXAMPLES = 12
"""Generated requests for each operation."""


@pytest.fixture(scope="module")
def contract() -> dict[str, Any]:
    return document()


def operations(contract: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in contract["paths"].items():
        for method, operation in methods.items():
            yield method, path, operation


def test_document_is_what_the_app_serves(contract: dict[str, Any], service: Running) -> None:
    written = yaml.safe_load((ROOT / "openapi.yaml").read_text("utf-8"))
    assert written == contract, "run: python -m specimap_service.openapi > openapi.yaml"
    assert httpx.get(f"{service.url}/openapi.json", trust_env=False).json() == contract
    assert contract["openapi"].startswith("3.1.")


def test_every_operation_says_what_it_is_and_how_it_refuses(contract: dict[str, Any]) -> None:
    ids = [operation["operationId"] for _, _, operation in operations(contract)]
    assert len(set(ids)) == len(ids)
    for method, path, operation in operations(contract):
        assert operation.get("summary"), f"{method} {path}"
        assert {"4XX", "5XX"} <= set(operation["responses"]), f"{method} {path}"
        refused = operation["responses"]["4XX"]["content"]
        assert "application/problem+json" in refused, f"{method} {path}"


def test_every_operation_but_health_wants_a_key(contract: dict[str, Any], service: Running) -> None:
    with httpx.Client(base_url=service.url, trust_env=False) as stranger:
        for method, path, operation in operations(contract):
            if path in ("/healthz", "/readyz"):
                continue
            assert operation["security"], f"{method} {path}"
            for name in ("key", "acquisition", "file", "job", "cloud", "project"):
                kind = {"acquisition": "acq", "project": "prj"}.get(name, name)
                path = path.replace(f"{{{name}_id}}", f"{kind}_{'0' * 26}")
            for name, value in {"upload_id": f"up_{'0' * 26}", "uuid": f"up_{'0' * 26}"}.items():
                path = path.replace(f"{{{name}}}", value)
            for name, value in {"key": "zarr.json", "name": "a", "format": "ply", "index": "0", "band": "0"}.items():
                path = path.replace(f"{{{name}}}", value)
            assert "{" not in path
            answer = stranger.request(method.upper(), path, headers={"Tus-Resumable": "1.0.0"})
            assert answer.status_code == 401, f"{method} {path}: {answer.status_code} {answer.text[:200]}"


def test_pages_of_the_contract_fetch_nothing_from_elsewhere(service: Running) -> None:
    with httpx.Client(base_url=service.url, trust_env=False) as reader:
        for page in ("/docs", "/redoc"):
            text = reader.get(page).text
            places = re.findall(r'(?:src|href)="([^"]+)"', text)
            assert len(places) >= 2
            for place in places:
                assert place.startswith("/static-offline-docs/"), place
                assert len(reader.get(place).content) > 1000


def test_corners_are_served_as_they_lie(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    client = service.client(["read"])
    links = client.get(f"/v1/clouds/{result.cloud_id}").json()["links"]
    answer = client.get(links["corners"])
    assert answer.content == (result.local / "corners.json").read_bytes()
    assert answer.headers["content-type"] == "application/json"
    assert client.get(links["corners"], headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_every_body_has_an_example(contract: dict[str, Any]) -> None:
    schemas = contract["components"]["schemas"]
    for method, path, operation in operations(contract):
        body = operation.get("requestBody", {}).get("content", {}).get("application/json")
        if body is not None:
            given = (body["schema"], *body["schema"].get("anyOf", []))
            names = [s["$ref"].rsplit("/", 1)[-1] for s in given if "$ref" in s]
            output = {*body, *body["schema"], *(word for name in names for word in schemas[name])}
            assert {"example", "examples"} & output, f"{method} {path}"


@pytest.mark.slow
def test_generated_requests_are_answered_as_the_contract_says(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    (tmp_path / "schemathesis.toml").write_text(
        f'[parameters]\n"path.cloud_id" = "{result.cloud_id}"\n"path.job_id" = "{result.job_id}"\n'
        f'"path.acquisition_id" = "{result.acquisition_id}"\n'
        f'[auth.openapi.key]\nbearer = "{service.key(rate_per_minute=1_000_000)}"\n',
        "utf-8",
    )
    done = subprocess.run(
        [
            str(Path(sys.executable).with_name("st")),
            "--config-file",
            str(tmp_path / "schemathesis.toml"),
            "run",
            f"{service.url}/openapi.json",
            "--phases",
            "examples,fuzzing",
            "--max-examples",
            str(EXAMPLES),
            "--seed",
            "7",
            "--workers",
            "2",
            "--exclude-checks",
            "unsupported_method,negative_data_rejection,positive_data_acceptance",
            "--generation-database",
            "none",
            "--no-color",
            "--suppress-health-check",
            "all",
        ],
        env={**os.environ, "SCHEMATHESIS_HOOKS": "schemathesis_hooks", "PYTHONPATH": str(SUPPORT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert httpx.get(f"{service.url}/readyz", trust_env=False).status_code == 200

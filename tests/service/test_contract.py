"""The contract: the document is what the app serves, and the app keeps it under generated requests."""

from __future__ import annotations

import json
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
from jsonschema import Draft202012Validator

from specimap_core.errors import BackendUnavailableError
from specimap_infra import jobs
from specimap_infra.study_keys import new_key
from specimap_service.auth import dependencies
from specimap_service.contract.description import operations
from specimap_service.contract.refusals import OWN
from specimap_service.errors import OverloadedError, RateLimitedError
from specimap_service.http_status import HTTP_STATUS
from specimap_service.problems import Problem
from tests.support import documented
from tests.support.access_scene import CASES
from tests.support.job_scene import acquisition, queued_job
from tests.support.places import ROOT, SUPPORT
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving

REFUSED = ["400", "401", "403", "404", "405", "406", "409", "412", "413", "415", "422", "428", "429", "5xx"]
EXAMPLES = 12
"""Generated requests for each operation."""


@pytest.fixture(scope="module")
def contract() -> dict[str, Any]:
    return documented.contract()


def resolved(contract: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """The part itself, or what it refers to."""
    while "$ref" in part:
        found: Any = contract
        for name in part["$ref"].removeprefix("#/").split("/"):
            found = found[name]
        part = found
    return part


def test_document_is_what_the_app_serves(contract: dict[str, Any], service: Running) -> None:
    written = yaml.safe_load((ROOT / "openapi.yaml").read_text("utf-8"))
    assert written == contract, "run: python -m specimap_service.openapi > openapi.yaml"
    assert httpx.get(f"{service.url}/openapi.json", trust_env=False, verify=NO_TLS).json() == contract
    assert contract["openapi"].startswith("3.1.")


def test_every_operation_says_what_it_is_and_how_it_refuses(contract: dict[str, Any]) -> None:
    ids = [operation["operationId"] for _, _, operation in operations(contract)]
    assert len(set(ids)) == len(ids)
    for method, path, operation in operations(contract):
        assert operation.get("summary"), f"{method} {path}"
        assert {"4XX", "5XX"} <= set(operation["responses"]), f"{method} {path}"
        for status, answer in operation["responses"].items():
            if status[0] in "45":
                refused = resolved(contract, answer)["content"]
                assert "application/problem+json" in refused, f"{method} {path}: {status}"


def test_every_operation_but_health_wants_a_key(contract: dict[str, Any], service: Running) -> None:
    with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as stranger:
        for method, path, operation in operations(contract):
            if path in ("/healthz", "/readyz") or operation["operationId"] == "sessions.create":
                continue
            assert operation["security"], f"{method} {path}"
            for name in ("key", "acquisition", "file", "job", "cloud", "project", "share"):
                kind = {"acquisition": "acq", "project": "prj", "share": "shr"}.get(name, name)
                path = path.replace(f"{{{name}_id}}", f"{kind}_{'0' * 26}")
            for name, value in {"upload_id": f"up_{'0' * 26}", "uuid": f"up_{'0' * 26}"}.items():
                path = path.replace(f"{{{name}}}", value)
            for name, value in {"key": "zarr.json", "name": "a", "format": "ply", "index": "0", "band": "0"}.items():
                path = path.replace(f"{{{name}}}", value)
            assert "{" not in path
            answer = stranger.request(method.upper(), path, headers={"Tus-Resumable": "1.0.0"})
            assert answer.status_code == 401, f"{method} {path}: {answer.status_code} {answer.text[:200]}"


def test_pages_of_the_contract_fetch_nothing_from_elsewhere(service: Running) -> None:
    with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as reader:
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


def test_cameras_are_served_as_they_lie_and_missed_in_older_results(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    client = service.client(["read"])
    address = client.get(f"/v1/clouds/{result.cloud_id}").json()["links"]["cameras"]
    answer = client.get(address)
    assert answer.content == (result.local / "cameras.json").read_bytes()
    assert answer.headers["content-type"] == "application/json"
    assert answer.json()["photos"][0]["camera"]["model"] == "pinhole"
    assert client.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    service.storage.delete(f"{result.prefix}/cameras.json")
    missing = client.get(address)
    assert (missing.status_code, missing.json()["code"]) == (404, "cameras_missing")
    assert f"/v1/jobs/{result.job_id}/rerun" in missing.json()["advice"]


VERBS = {
    *("append", "cancel", "create", "delete", "follow", "get", "head", "list", "put", "rerun", "revoke", "select"),
    *("receive", "search", "send", "update"),
}


def test_operations_are_named_by_resource_and_verb(contract: dict[str, Any]) -> None:
    for method, path, operation in operations(contract):
        name = operation["operationId"]
        assert re.fullmatch(r"[a-z]+\.[a-z]+(_[a-z]+)?", name), f"{method} {path}: {name}"
        resource, _, action = name.partition(".")
        assert resource == ("audit" if path == "/v1/audit" else operation["tags"][0]), f"{method} {path}: {name}"
        verb = action.partition("_")[0]
        assert verb in VERBS, f"{method} {path}: {name}"
        allowed = {
            "get": {"get", "list", "follow"},
            "head": {"get", "head"},
            "options": {"get"},
            "put": {"put"},
            "patch": {"update", "append"},
            "delete": {"delete", "revoke"},
            "post": {"create", "cancel", "receive", "rerun", "search", "select", "send"},
        }
        assert verb in allowed[method], f"{method} {path}: {name}"
    for name in contract["components"]["schemas"]:
        assert re.fullmatch(r"[A-Z][A-Za-z0-9]+", name), name
        assert not name.endswith(("View", "Answer")), name


def test_scope_of_each_operation_is_the_one_that_is_checked(contract: dict[str, Any]) -> None:
    for method, path, operation in operations(contract):
        if path in ("/healthz", "/readyz") or operation["operationId"] == "sessions.create":
            assert "security" not in operation
        else:
            case = CASES[method.upper(), path]
            scopes = [] if case.scope is None else [case.scope]
            assert operation["security"] == [{"key": scopes}, {"session": scopes}], f"{method} {path}"
            assert all(f"Scope: `{scope}`." in operation["description"] for scope in scopes)


def test_refusals_are_those_of_the_table_of_statuses(contract: dict[str, Any]) -> None:
    assert set(OWN) <= {operation["operationId"] for _, _, operation in operations(contract)}
    codes = {leaf.code: leaf for leaf in HTTP_STATUS}
    for method, path, operation in operations(contract):
        answers = {s: resolved(contract, a) for s, a in operation["responses"].items() if s[0] in "45" and s[1] != "X"}
        expected = {"422", "503"}
        if operation.get("security"):
            expected |= {"401", "403", "429"}
        if "{" in path:
            expected.add("404")
        if "requestBody" in operation:
            expected.add("413")
        assert expected <= set(answers), f"{method} {path}: {expected - set(answers)}"
        for status, answer in answers.items():
            examples = answer["content"]["application/problem+json"]["examples"]
            assert set(examples) == set(answer["x-codes"])
            for code in answer["x-codes"]:
                assert f"`{code}`" in answer["description"]
                problem = Problem.model_validate(examples[code]["value"])
                assert (problem.status, problem.code) == (int(status), code)
            late = any(issubclass(codes[code], (RateLimitedError, OverloadedError)) for code in answer["x-codes"])
            assert "Retry-After" in answer.get("headers", {}) or not late, f"{method} {path}: {status}"
            assert "Retry-After" in answer.get("headers", {}) or status != "429"


def json_schema(contract: dict[str, Any], schema: dict[str, Any]) -> Draft202012Validator:
    return Draft202012Validator({**schema, "components": contract["components"]})


def test_bodies_and_answers_have_examples_that_fit_them(contract: dict[str, Any]) -> None:
    def check(content: dict[str, Any], where: str) -> None:
        schema = content.get("schema", {})
        parts = [schema, *schema.get("anyOf", [])]
        if any(part.get("format") == "binary" for part in parts):
            return
        given = [content, *(resolved(contract, part) for part in parts)]
        examples = [part["example"] for part in given if "example" in part]
        assert examples, where
        for example in examples:
            json_schema(contract, schema).validate(example)

    for method, path, operation in operations(contract):
        for media, content in operation.get("requestBody", {}).get("content", {}).items():
            if media != "multipart/form-data":
                check(content, f"{method} {path}: body as {media}")
            else:
                assert "example" in content
        for status, answer in operation["responses"].items():
            for media, content in answer.get("content", {}).items():
                if status[0] == "2" and method != "head":
                    check(content, f"{method} {path}: {status} as {media}")


def test_nothing_is_described_that_is_refused(contract: dict[str, Any]) -> None:
    said = str(contract).lower()
    for word in ("upload-concat", "upload-defer-length", "post_request"):
        assert word not in said


def test_servers_lead_to_the_service(contract: dict[str, Any], service: Running) -> None:
    (server,) = contract["servers"]
    assert (
        httpx.get(
            httpx.URL(service.url).join(server["url"]).join("healthz"), trust_env=False, verify=NO_TLS
        ).status_code
        == 200
    )


def test_events_hold_what_the_contract_says(contract: dict[str, Any], service: Running) -> None:
    database, client = service.database, service.client(["read", "upload"])
    job = queued_job(database, acquisition(database))
    with database.session() as session:
        jobs.claim(session, job, "executor")
        jobs.report_progress(session, job, "executor", "render", 0.5)
        jobs.log(session, job, "executor", "info", "A line.", photo="photo-0001.jpg")
        jobs.finish(session, job, "executor", "failed", BackendUnavailableError("None.", advice="Add one."))
    stream = contract["paths"]["/v1/jobs/{job_id}/events"]["get"]["responses"]["200"]["content"]["text/event-stream"]
    types = {item["properties"]["event"]["const"]: item for item in stream["x-item-schema"]["oneOf"]}
    seen = set()
    for block in client.get(f"/v1/jobs/{job}/events").text.strip().split("\n\n"):
        event = dict(line.split(": ", 1) for line in block.split("\n"))
        item = types[event["event"]]
        json_schema(contract, item).validate(event)
        data = json.loads(event["data"])
        json_schema(contract, item["properties"]["data"]["contentSchema"]).validate(data)
        known = resolved(contract, item["properties"]["data"]["contentSchema"])["properties"]
        assert set(data) <= set(known), data
        seen.add(event["event"])
    assert seen == set(types) == {"state", "progress", "log"}


@pytest.fixture
def keyed(tmp_path: Path) -> Iterator[Running]:
    """A service that keeps study contexts, which without a key it cannot."""
    with serving(tmp_path / "service", study_keys=[new_key()]) as running:
        yield running


@pytest.mark.slow
def test_generated_requests_are_answered_as_the_contract_says(
    keyed: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = keyed
    # Wrong keys and cookies come faster than one address may present them.
    monkeypatch.setattr(dependencies, "FAILURES_PER_MINUTE", 1_000_000)
    result = put_result(service, tmp_path / "result")
    (tmp_path / "schemathesis.toml").write_text(
        f'[parameters]\n"path.cloud_id" = "{result.cloud_id}"\n"path.job_id" = "{result.job_id}"\n'
        f'"path.acquisition_id" = "{result.acquisition_id}"\n'
        # tus wants 412 for another version of the protocol.
        f"[checks.negative_data_rejection]\nexpected-statuses = {REFUSED}\n"
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
            "--request-timeout",
            "60",
            # A check of the hooks stands in for it, which knows the reasons for refusals that no schema can tell.
            "--exclude-checks",
            "positive_data_acceptance",
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
    assert done.returncode == 0, done.stdout[-20_000:] + done.stderr[-2000:]
    assert httpx.get(f"{service.url}/readyz", trust_env=False, verify=NO_TLS).status_code == 200

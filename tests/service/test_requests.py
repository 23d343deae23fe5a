"""What holds for every operation of the contract: HEAD where there is GET, no unknown parameter in the query."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from specimap_infra.projects import DEFAULT_PROJECT
from tests.support.job_scene import queued_job
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import TUS, create, new_acquisition, photos, sent

EXAMPLES = {"bands/{band}": "bands/1", "{index}": "3", "{key}": "zarr.json", "{format}": "mesh-ply", "{name}": "x"}
VOLATILE = {"date", "ratelimit", "x-correlation-id", "transfer-encoding"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Running, Result, dict[str, str]]]:
    """A service, a result in it, and values of the parameters in paths."""
    folder = tmp_path_factory.mktemp("requests")
    with serving(folder / "service") as running:
        result = put_result(running, folder / "result")
        client = running.client()
        acquisition = new_acquisition(client)
        file = sent(client, acquisition, "photo", "x.jpg", photos()[0].read_bytes())
        upload = create(client, acquisition, "photo", 10).headers["location"].rsplit("/", 1)[1]
        yield (
            running,
            result,
            {
                "cloud_id": result.cloud_id,
                "job_id": result.job_id,
                "acquisition_id": acquisition,
                "file_id": file["id"],
                "upload_id": upload,
                "uuid": upload,
                "key_id": f"key_{'0' * 26}",
                "project_id": DEFAULT_PROJECT,
                "share_id": f"shr_{'0' * 26}",
            },
        )


def operations(app: Any) -> Iterator[tuple[str, str, list[dict[str, Any]]]]:
    """Method, path and query parameters of every operation."""
    for path, methods in app.openapi()["paths"].items():
        for method, operation in methods.items():
            query = [p for p in operation.get("parameters", []) if p["in"] == "query"]
            yield method.upper(), path, query


def filled(path: str, ids: dict[str, str]) -> str:
    for part, example in EXAMPLES.items():
        path = path.replace(part, example)
    return re.sub(r"{(\w+)}", lambda found: ids[found[1]], path)


REQUIRED = {"index.png": {"a": "1", "b": "0"}, "band.png": {"b": "1"}, "label.png": {"name": "x"}}


def test_head_is_get_without_its_content(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, _, ids = scene
    client = service.client()
    paths = {path for method, path, _ in operations(service.app) if method == "GET"}
    assert len(paths) > 30
    answered = 0
    for path in [*sorted(paths), "/openapi.json", "/docs"]:
        at, query = filled(path, ids), REQUIRED.get(path.rsplit("/", 1)[1], {})
        got, head = client.get(at, params=query), client.head(at, params=query)
        assert head.status_code == got.status_code, path
        assert head.content == b"", path
        if path not in ("/metrics", "/readyz"):
            same = [{k: v for k, v in answer.headers.items() if k not in VOLATILE} for answer in (head, got)]
            if "content-length" not in same[0]:
                same[1].pop("content-length", None)
            if got.status_code < 400:
                assert same[0] == same[1], path
        answered += got.status_code < 300
    assert answered > 22


def test_head_counts_as_its_route_in_metrics(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, *_ = scene
    client = service.client()
    assert client.head("/v1/keys").status_code == 200
    assert re.search(r'method="HEAD",route="/v1/keys",status="200"', client.get("/metrics").text)


def test_head_of_a_file_ignores_ranges_and_reads_nothing_of_it(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, _, ids = scene
    client = service.client()
    at = f"/v1/acquisitions/{ids['acquisition_id']}/files/{ids['file_id']}/content"
    head = client.head(at, headers={"Range": "bytes=0-9"})
    assert (head.status_code, int(head.headers["content-length"])) == (200, photos()[0].stat().st_size)
    assert client.head(at, headers={"If-None-Match": head.headers["etag"]}).status_code == 304


def test_head_of_a_stream_ends_at_once(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, *_ = scene
    client = service.client(["read"])
    job_id = queued_job(service.database)
    for _ in range(3):
        head = client.head(f"/v1/jobs/{job_id}/events", timeout=10)
        assert head.status_code == 200
        assert head.headers["content-type"].startswith("text/event-stream")
    deadline = time.monotonic() + 10
    while service.app.state.streams._counts:
        assert time.monotonic() < deadline, "the places are not given back"
        time.sleep(0.02)


def test_head_of_an_upload_stays_that_of_tus(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, _, ids = scene
    client = service.client()
    head = client.head(f"/v1/uploads/{ids['upload_id']}", headers=TUS)
    assert (head.status_code, head.headers["upload-offset"]) == (200, "0")
    assert client.head("/v1/nothing").status_code == 404
    assert client.head("/v1/jobs/x/cancel").status_code == 405
    with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as stranger:
        assert stranger.head("/healthz").status_code == 200
        assert stranger.head("/v1/keys").status_code == 401


def test_no_operation_takes_a_parameter_that_it_does_not_know(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, _, ids = scene
    client = service.client()
    seen = 0
    for method, path, query in operations(service.app):
        at = filled(path, ids)
        answer = client.request(method, at, params={"specimen": "x"}, headers={**TUS, "Specimap-Page": "1"})
        if path == "/v1/sso/callback":
            # An identity provider adds parameters of its own.
            assert answer.json()["code"] == "sign_in_not_configured"
            continue
        assert answer.status_code == 422, (method, path, answer.text)
        if method != "HEAD":
            problem = answer.json()
            assert problem["code"] == "request_invalid"
            assert problem["details"]["fields"] == [{"where": "query.specimen", "what": "not known here"}]
            names = [p["name"] for p in query]
            assert sorted(problem["details"]["known"]) == sorted(names)
            assert all(name in problem["advice"] for name in names)
        seen += 1
    assert seen > 50


def test_single_parameters_are_given_once(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, _, ids = scene
    client = service.client()
    lists = singles = 0
    for method, path, query in operations(service.app):
        if method != "GET":
            continue
        for parameter in query:
            name, at = parameter["name"], filled(path, ids)
            answer = client.get(f"{at}?{name}=1&{name}=2")
            twice = {"where": f"query.{name}", "what": "given more than once"}
            if '"array"' in str(parameter["schema"]).replace("'", '"'):
                lists += 1
                assert twice not in answer.json().get("details", {}).get("fields", [])
            else:
                singles += 1
                assert answer.status_code == 422, (path, name)
                assert answer.json()["details"]["fields"] == [twice]
    assert lists >= 1
    assert singles > 30


def test_a_misspelt_filter_lists_nothing(scene: tuple[Running, Result, dict[str, str]]) -> None:
    service, *_ = scene
    answer = service.client().get("/v1/acquisitions?specimen=x")
    assert answer.status_code == 422
    assert "specimen_id" in answer.json()["advice"]
    assert service.client().get("/v1/acquisitions?specimen_id=x").json()["items"] == []
    assert service.client().get("/v1/jobs?state=queued&state=running").status_code == 200


def test_what_no_database_takes_is_refused(any_database: str, tmp_path: Path) -> None:
    wanted = {
        "acquisitions?specimen_id=a%00": "specimen_id",
        "acquisitions?accession_number=%00": "accession_number",
        "clouds?specimen_id=%00": "specimen_id",
        "clouds?acquisition_id=%00": "acquisition_id",
        f"audit?after={2**63}": "after",
    }
    with serving(tmp_path / "service", database_url=any_database) as service:
        client = service.client()
        for address, name in wanted.items():
            answer = client.get(f"/v1/{address}")
            assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid"), address
            assert [field["where"] for field in answer.json()["details"]["fields"]] == [f"query.{name}"]

"""Lists: every one in pages, in either order; answers compressed, with the rate that is left."""

from __future__ import annotations

import datetime
import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import Delivery, DicomSet, Erasure, StoredFile
from specimap_service.contract.description import operations
from tests.support.access_scene import JUDGEMENT
from tests.support.documented import contract
from tests.support.job_scene import acquisition, queued_job
from tests.support.label_files import header, npy
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import Running

PLAIN = {"Accept-Encoding": "identity"}


def full_lists(service: Running, client: httpx.Client, folder: Path) -> dict[str, str]:
    """Fill every list of the service with three items or more; return their addresses by operation."""
    for name in ("a", "b", "c"):
        client.post("/v1/projects", json={"name": name})
        client.post("/v1/keys", json={"name": name, "scopes": ["read"]})
        client.post("/v1/acquisitions", json={"specimen_id": name})
    result = put_result(service, folder / "result")
    for number in range(2):
        put_result(service, folder / f"result-{number}", acquisition_id=result.acquisition_id)
    cloud = f"/v1/clouds/{result.cloud_id}"
    points = result.cloud.n_points
    for number, name in enumerate(("c", "a", "b", "a", "a")):
        values = (np.arange(points) < number).astype(np.uint8)
        answer = client.put(f"{cloud}/labels/{name}", content=npy(values), headers=header())
        assert answer.status_code == 201, answer.text
    soon = (utc_now() + datetime.timedelta(days=1)).isoformat()
    for name in ("a", "b", "c"):
        assert client.post(f"{cloud}/shares", json={"name": name, "expires_at": soon}).status_code == 201
    for format in ("npz", "ply"):
        client.post(f"{cloud}/exports/{format}")
    owner = acquisition(service.database)
    job = queued_job(service.database, owner)
    with service.database.session() as session:
        for stored in session.scalars(sa.select(StoredFile).where(StoredFile.acquisition_id == owner)):
            stored.judgement = JUDGEMENT
        jobs.claim(session, job, "executor")
        for number in range(4):
            jobs.log(session, job, "executor", "info", f"Line {number}.")
    notified = queued_job(service.database, owner, webhook={"url": "http://127.0.0.1:9/", "secret": "0" * 16})
    with service.database.session() as session:
        jobs.request_cancel(session, notified)
        session.add_all(
            DicomSet(
                id=new_id("dcs"),
                cloud_id=result.cloud_id,
                options={"bands": [number]},
                first=False,
                study_version=1,
                state="waiting",
                created_by="key_test",
            )
            for number in range(3)
        )
        session.add_all(Delivery(id=new_id("dlv"), job_id=notified, state="given_up") for _ in range(3))
        session.add_all(
            Erasure(id=new_id("ers"), specimen_hash="0", acquisitions=[], removal={}, state="done", created_by="k")
            for _ in range(3)
        )
    return {
        "deliveries.list": f"/v1/jobs/{notified}/deliveries",
        "projects.list": "/v1/projects",
        "keys.list": "/v1/keys",
        "audit.list": "/v1/audit",
        "acquisitions.list": "/v1/acquisitions",
        "files.list": f"/v1/acquisitions/{owner}/files",
        "jobs.list": "/v1/jobs",
        "jobs.get_log": f"/v1/jobs/{job}/log",
        "clouds.list": "/v1/clouds",
        "labels.list": f"{cloud}/labels",
        "labels.list_versions": f"{cloud}/labels/a/versions",
        "exports.list": f"{cloud}/exports",
        "shares.list": f"{cloud}/shares",
        "erasures.list": "/v1/erasures",
        "dicom.list": f"{cloud}/dicom",
    }


def walked(client: httpx.Client, address: str, **query: Any) -> list[Any]:
    """All items of a list, two at a time."""
    found: list[Any] = []
    answer = client.get(address, params={**query, "limit": 2})
    while True:
        assert answer.status_code == 200, answer.text
        page = answer.json()
        items = page if isinstance(page, list) else page["items"]
        assert len(items) <= 2
        found += items
        if isinstance(page, list):
            place = answer.links.get("next", {}).get("url")
            if place is None:
                return found
            assert len(items) == 2
            answer = client.get(place)
        elif page["next"] is None:
            return found
        else:
            answer = client.get(address, params={**query, "limit": 2, "after": page["next"]})


def test_every_list_comes_in_pages_in_either_order(service: Running, tmp_path: Path) -> None:
    client = service.client()
    addresses = full_lists(service, client, tmp_path)
    described = {
        operation["operationId"]: {parameter["name"]: parameter for parameter in operation["parameters"]}
        for method, _, operation in operations(contract())
        if method == "get" and re.search(r"\.(list|get_log)", operation["operationId"])
    }
    assert set(described) == set(addresses)
    for name, address in addresses.items():
        known = described[name]
        assert {"limit", "after", "sort"} <= set(known), name
        for parameter in known.values():
            assert parameter.get("description") or parameter["in"] == "path", f"{name}: {parameter['name']}"
        whole = client.get(address).json()
        items = whole if isinstance(whole, list) else whole["items"]
        assert len(items) >= 3, name
        forwards, backwards = known["sort"]["schema"]["enum"]
        usual = known["sort"]["schema"]["default"]
        assert walked(client, address) == items, name
        assert walked(client, address, sort=usual) == items, name
        assert walked(client, address, sort=backwards if usual == forwards else forwards) == items[::-1], name
        assert client.get(address, params={"sort": "colour"}).status_code == 422


def test_answers_tell_the_rate_that_is_left(service: Running) -> None:
    client = service.client(rate_per_minute=3)
    for left in (2, 1, 0):
        answer = client.get("/v1/jobs" if left else "/v1/jobs/x")
        assert answer.headers["ratelimit-policy"] == '"key";q=3;w=60'
        found = re.fullmatch(r'"key";r=(\d+);t=(\d+)', answer.headers["ratelimit"])
        assert found is not None
        assert int(found[1]) == left
        assert 0 < int(found[2]) <= 60
    refused = client.get("/v1/jobs")
    assert refused.status_code == 429
    assert refused.headers["ratelimit"] == f'"key";r=0;t={refused.headers["retry-after"]}'
    assert "ratelimit" not in httpx.get(f"{service.url}/healthz", trust_env=False, verify=NO_TLS).headers
    assert "ratelimit" in client.head("/v1/jobs").headers
    assert "ratelimit" in client.post("/v1/jobs", json={}).headers


def test_json_is_compressed_for_who_accepts_it(service: Running, tmp_path: Path) -> None:
    client = service.client()
    result = put_result(service, tmp_path / "result")
    cloud = f"/v1/clouds/{result.cloud_id}"
    body = {"select": {"indices": list(range(500))}}
    for given, encoding in (
        ("gzip", "gzip"),
        ("br, gzip;q=0.5", "gzip"),
        ("identity", None),
        ("gzip;q=0", None),
        ("br", None),
    ):
        answer = client.post(f"{cloud}/spectra", json=body, headers={"Accept-Encoding": given})
        assert answer.headers.get("content-encoding") == encoding, given
        assert "accept-encoding" in answer.headers["vary"].lower()
        assert answer.json()["total"] == 500
    sizes = [
        int(client.get("/openapi.json", headers={"Accept-Encoding": given}).headers["content-length"])
        for given in ("gzip", "identity")
    ]
    assert sizes[0] < sizes[1] / 5
    # The bytes that a tag names are the same for all.
    for path in ("zarr/zarr.json", "bands/0", "corners"):
        one, other = (
            client.get(f"{cloud}/{path}", headers={"Accept": "application/json", **more})
            for more in ({"Accept-Encoding": "gzip"}, PLAIN)
        )
        assert one.headers["etag"] == other.headers["etag"]
        assert "content-encoding" not in one.headers
        known = client.get(
            f"{cloud}/{path}", headers={"If-None-Match": one.headers["etag"], "Accept": "application/json"}
        )
        assert known.status_code == 304
    # Neither are arrays, pictures and stored files, nor parts of them.
    client.headers["Accept-Encoding"] = "gzip"
    for path, more in (
        ("zarr/spectra/c/0/0", {}),
        ("zarr/zarr.json", {"Range": "bytes=0-1999"}),
        ("previews/rgb.png", {}),
        ("exports/mesh-ply/content", {}),
        ("bands/0", {"Accept": "application/x-npy"}),
        ("bands/0", {"Accept": "application/vnd.apache.arrow.stream"}),
    ):
        answer = client.get(f"{cloud}/{path}", headers=more)
        assert answer.is_success, path
        assert "content-encoding" not in answer.headers, path
        assert len(answer.content) > 1000

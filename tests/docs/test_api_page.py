"""docs/api.md against a running service: run every command and program of the page, in its order."""

from __future__ import annotations

import json
import re
import shutil
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from matplotlib.path import Path as Outline

from specimap_core.cloud import Cloud
from specimap_infra import jobs
from specimap_infra.webhooks import deliver_due, sign, webhook_client
from tests.support.docs_scene import PAGE, Reader, documents, header
from tests.support.export_scene import make
from tests.support.places import SAMPLES
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import serving
from tests.support.upload_scene import photos, sent

EXECUTOR = "host:0:page"
SECRET = "0123456789abcdef"
NO_PROXY = {"NO_PROXY": "127.0.0.1", "no_proxy": "127.0.0.1"}
SPLIT = 50_000
"""Where the page breaks its upload."""
pytestmark = pytest.mark.skipif(
    shutil.which("bash") is None or shutil.which("curl") is None, reason="bash and curl are not on this machine"
)


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Reader]:
    with serving(tmp_path / "service", webhook_hosts=["127.0.0.1"]) as service:
        result = put_result(service, tmp_path / "result", specimen_id="SP-2026-0117")
        service.client()
        for number, photo in enumerate(photos()[:7], 1):
            shutil.copy(photo, tmp_path / f"IMG_{number:04d}.jpg")
        for end in ("hdr", "raw"):
            shutil.copy(SAMPLES / "hsi" / f"hsi.{end}", tmp_path / f"scan.{end}")
        variables = {"SPECIMAP_URL": service.url, "SPECIMAP_KEY": service.key(), "CLOUD": result.cloud_id}
        monkeypatch.chdir(tmp_path)
        for name, value in {**variables, **NO_PROXY, "WEBHOOK_SECRET": SECRET}.items():
            monkeypatch.setenv(name, value)
        yield Reader(service, tmp_path, result, variables)


def keys(reader: Reader) -> None:
    assert reader.sh("The API") == ""
    (made,) = documents(reader.sh("Keys"))
    assert made["scopes"] == ["upload", "read"]
    bearer = {"Authorization": f"Bearer {made['key']}"}
    assert httpx.get(f"{reader.service.url}/v1/jobs", headers=bearer, trust_env=False, verify=NO_TLS).status_code == 200
    reader.variables["KEY_ID"] = made["id"]
    assert reader.sh("Keys") == ""
    assert httpx.get(f"{reader.service.url}/v1/jobs", headers=bearer, trust_env=False, verify=NO_TLS).status_code == 401


def projects(reader: Reader) -> None:
    project, key, listed = documents(reader.sh("Projects"))
    assert (project["name"], key["project_id"], listed["items"]) == ("study-7", project["id"], [])
    reader.variables["PROJECT"] = project["id"]
    (renamed,) = documents(reader.sh("Projects"))
    assert renamed == {**project, "name": "study-8"}


def errors(reader: Reader) -> None:
    (answer,) = documents(reader.sh("Errors", status=22))
    shown = json.loads(reader.next("Errors", "json"))
    assert {**answer, "correlation_id": ""} == {**shown, "correlation_id": ""}
    assert len(answer["correlation_id"]) == len(shown["correlation_id"])


def uploads(reader: Reader) -> None:
    reader.variables["ACQ"] = reader.result.acquisition_id
    made, listed, _ = documents(reader.sh("Acquisitions"))
    assert [item["id"] for item in listed["items"]] == [made["id"], reader.result.acquisition_id]
    reader.variables["ACQ"] = made["id"]

    two, cube = documents(reader.sh("In a form"))
    assert [file["label"] for file in two] == ["photo-0001.jpg", "photo-0002.jpg"]
    assert [file["judgement"]["part"] for file in cube] == ["header", "data"]

    reader.variables["UPLOAD"] = header(reader.sh("Resumable"), "location").rpartition("/")[2]
    assert reader.sh("Resumable") == ""
    resumed = reader.sh("Resumable")
    photo = reader.folder / "IMG_0003.jpg"
    assert re.findall(r"^upload-offset: (\d+)", resumed, re.MULTILINE | re.IGNORECASE) == [
        str(SPLIT),
        str(photo.stat().st_size),
    ]
    assert header(resumed, "specimap-verdict") == "accepted"
    (result,) = documents(reader.sh("Resumable"))
    assert (result["state"], result["file"]["id"]) == ("finished", header(resumed, "specimap-file"))

    shown = json.loads(reader.next("Judgements", "json"))
    assert {name: shown["judgement"].keys() for name in shown} == {
        name: result["file"]["judgement"].keys() for name in result["file"]
    }
    for number in range(4, 8):
        name = f"IMG_{number:04d}.jpg"
        sent(reader.client, made["id"], "photo", name, (reader.folder / name).read_bytes())
    reader.variables["FILE"] = result["file"]["id"]
    (files,) = documents(reader.sh("Judgements"))
    assert len(files) == 9
    assert (reader.folder / "original.jpg").read_bytes() == photo.read_bytes()
    now = reader.client.get(f"/v1/acquisitions/{made['id']}").json()
    assert (now["files"]["photos"], now["ready"], now["missing"]) == (6, True, [])
    (dome,) = documents(reader.sh("Viewpoints"))
    assert [len(dome["photos"]), len(dome["unplaced"]), dome["enough"]] == [6, 0, False]
    assert Counter(cell["elevation_deg"] for cell in dome["cells"]) == {35: 10, 55: 8, 75: 4}
    assert "v1/uploads" in reader.next("A page on a tablet", "js")


def jobs_and_events(reader: Reader) -> None:
    reader.variables["JOB"] = reader.result.job_id
    made, _ = documents(reader.sh("Jobs"))
    assert (made["state"], made["priority"], made["settings"]["r_pc"]) == ("queued", "intraoperative", 0.5)
    reader.variables["JOB"] = made["id"]
    (again,) = documents(reader.sh("Jobs"))
    assert (again["rerun_of"], again["settings"]["method"], again["settings"]["r_pc"]) == (
        made["id"],
        "homography",
        0.5,
    )
    listed, cancelled, log = documents(reader.sh("Jobs"))
    assert [job["id"] for job in listed["items"]] == [again["id"], made["id"]]
    assert cancelled["state"] == "cancelled"
    assert log["items"] == []

    with reader.service.database.session() as session:
        jobs.claim(session, again["id"], EXECUTOR)
        jobs.report_progress(session, again["id"], EXECUTOR, "reconstruct", 0.25)
        jobs.log(session, again["id"], EXECUTOR, "info", "Stage adjust is there.", stage="adjust")
        jobs.finish(session, again["id"], EXECUTOR, "succeeded")
    reader.variables["JOB"] = again["id"]
    sent_events, shown = events(reader.sh("Events")), events(reader.next("Events", "text"))
    assert [seq for seq, _, _ in sent_events] == [1, 2, 3, 4, 5]
    assert [(seq, kind, data.keys()) for seq, kind, data in sent_events[1:]] == [
        (seq, kind, data.keys()) for seq, kind, data in shown
    ]
    assert events(reader.sh("Events")) == sent_events[3:]
    after = reader.client.get(f"/v1/jobs/{again['id']}/events", headers={"Last-Event-ID": "5"})
    assert after.status_code == 204


def events(text: str) -> list[tuple[int, str, dict[str, Any]]]:
    found = re.findall(r"^event: (\w+)\ndata: (.*)\nid: (\d+)$", text, re.MULTILINE)
    return [(int(seq), kind, json.loads(data)) for kind, data, seq in found]


@contextmanager
def receiving(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """The address of a server that runs until the block ends."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()


def webhook(reader: Reader) -> None:
    program = reader.python("Webhooks")
    printed: list[tuple[str | None, ...]] = []
    program["print"] = lambda *words: printed.append(words)
    with receiving(program["Hook"]) as url, webhook_client() as sender:
        job = {"acquisition_id": reader.variables["ACQ"], "webhook": {"url": url, "secret": SECRET}}
        job_id = reader.client.post("/v1/jobs", json=job).json()["id"]
        reader.client.post(f"/v1/jobs/{job_id}/cancel")
        assert deliver_due(reader.service.database, reader.service.settings, sender) == 1
        assert printed == [("job.cancelled", job_id, None)]

        def post(signature: str, delivery: str) -> int:
            headers = {b"X-Specimap-Signature": signature.encode("latin-1"), b"X-Specimap-Delivery": delivery.encode()}
            return sender.post(url, content=body, headers=headers).status_code

        body, now = json.dumps({"event": "job.failed", "job": {"id": "job_1", "cloud_id": None}}).encode(), time.time()
        good = sign(SECRET, body, int(now))
        assert [post(good, "dlv_1"), post(good, "dlv_1")] == [204, 204]
        assert printed[1:] == [("job.failed", "job_1", None)]
        forged = (sign("another secret of 16", body, int(now)), sign(SECRET, body, int(now) - 1000), "", "t=,v1=ü")
        assert [post(signature, "dlv_2") for signature in forged] == [400] * 4
        assert len(printed) == 2


def results(reader: Reader) -> None:
    cloud, cloud_id = reader.result.cloud, reader.result.cloud_id
    listed, shown = documents(reader.sh("Results"))
    assert [item["id"] for item in listed["items"]] == [cloud_id]
    assert shown["points"] == cloud.n_points

    (root,) = documents(reader.sh("Zarr over HTTP"))
    assert {"spectra", "xyz", "flags"} <= set(root["consolidated_metadata"]["metadata"])
    read = reader.python("Zarr over HTTP", cloud_id=cloud_id)["first"]
    np.testing.assert_allclose(read, cloud.spectra(slice(0, 256)), rtol=1e-6)
    spectra(reader, cloud)

    reader.sh("Previews")
    for name in ("rgb", "pca", "band", "composite", "index"):
        assert (reader.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")

    whole = reader.client.post(f"/v1/clouds/{cloud_id}/exports/las")
    make(reader.service, whole.json()["id"])
    content = reader.client.get(f"/v1/clouds/{cloud_id}/exports/las/content").content
    (reader.folder / "cloud.las").write_bytes(content[:100])
    assert [export["state"] for export in documents(reader.sh("Exports"))] == ["succeeded", "succeeded"]
    assert (reader.folder / "cloud.las").read_bytes() == content


def spectra(reader: Reader, cloud: Cloud) -> None:
    (point,) = documents(reader.sh("Spectra"))
    assert (point["index"], point["bands"]) == (17, [0, 3, 4, 5])
    selections = [answer["indices"] for answer in documents(reader.sh("Spectra"))]
    pixels = [index for row, col in ((200, 200), (201, 200)) if (index := cloud.at_pixel(row, col)) is not None]
    centre = (2.0, -3.0, 7.0)
    triangle = cloud.in_polygon([(10, 10), (10, 30), (210, 210)])
    near = cloud.in_radius(centre, 6)
    expected: list[Any] = [
        [17, 4, 5],
        pixels,
        triangle,
        cloud.nearest(centre, 8)[0],
        cloud.in_box((0, -4, -5), (4, 0, 15)),
        near,
    ]
    assert selections == [list(indices) for indices in expected]
    (page,) = documents(reader.sh("Spectra"))
    assert (page["total"], page["bands"]) == (len(near), [1, 2, 3])
    assert page["indices"] == list(near[20:40])
    assert page["fields"].keys() == {"xyz", "distance_mm"}
    (band,) = documents(reader.sh("Spectra"))
    np.testing.assert_allclose(band["values"], cloud.band(3), rtol=1e-6)
    table: pa.Table = reader.python("Spectra", cloud_id=reader.result.cloud_id)["table"]
    assert table.column_names == ["index", "xyz", "spectrum"]
    np.testing.assert_array_equal(table["index"].to_numpy(), triangle)
    assert len(triangle) > 200


def labels(reader: Reader) -> None:
    values = reader.python("Labels", points=reader.result.cloud.n_points)["values"]
    put, listed = documents(reader.sh("Labels"))
    assert (put["version"], [label["name"] for label in listed]) == (1, ["tissue"])
    np.testing.assert_array_equal(np.load(reader.folder / "back.npy"), values)
    assert (reader.folder / "label.png").read_bytes().startswith(b"\x89PNG")
    root = reader.client.get(f"/v1/clouds/{reader.result.cloud_id}/zarr/zarr.json").json()
    assert "labels/tissue" in root["consolidated_metadata"]["metadata"]


def lists_and_ranges(reader: Reader) -> None:
    listed = [job["id"] for job in reader.client.get("/v1/jobs").json()["items"]]
    reader.variables["JOB"] = listed[0]
    first, second = documents(reader.sh("Lists, ranges, limits"))
    assert [page["items"][0]["id"] for page in (first, second)] == listed[:2]
    assert first["next"] == listed[0]
    answer = reader.sh("Lists, ranges, limits")
    mesh = (reader.result.local / "mesh.ply").read_bytes()
    assert header(answer, "content-range") == f"bytes 0-99/{len(mesh)}"
    assert (reader.folder / "head.ply").read_bytes() == mesh[:100]


@pytest.mark.slow
def test_everything_on_the_page_does_what_it_says(reader: Reader) -> None:
    for part in (keys, projects, errors, uploads, jobs_and_events, webhook, results, labels, lists_and_ranges):
        part(reader)
    assert {title: rest for title, rest in reader.left.items() if rest} == {}


def test_metrics_on_the_page_are_those_of_the_service(reader: Reader) -> None:
    text = reader.client.get("/metrics").text
    served = {name for name in re.findall(r"^# TYPE (\w+) ", text, re.MULTILINE) if not name.endswith("_created")}
    assert served == set(re.findall(r"`(specimap_[a-z_]+)`", PAGE.read_text("utf-8")))


def test_examples_of_selections_hit_the_sample() -> None:
    """Judged by the truth of the sample: a reader who follows the page on it gets points."""
    with np.load(SAMPLES / "truth.npz") as truth:
        xyz, kind = truth["hsi_xyz"], truth["hsi_class"]
    there = kind > 0
    page = PAGE.read_text("utf-8")
    wanted = [json.loads(text) for text in re.findall(r"""spectra '(\{"select": .*\})'""", page)]
    seen = set()
    for select in (item["select"] for item in wanted):
        (name, given), *_ = select.items()
        seen.add(name)
        if name == "pixels":
            assert all(there[row, col] for row, col in given)
        elif name == "box":
            inside = np.all((xyz >= given["low"]) & (xyz <= given["high"]), axis=-1)
            assert (inside & there).sum() > 100
        elif name == "radius":
            near = np.linalg.norm(xyz - np.array(given["centre"]), axis=-1) <= given["radius_mm"]
            assert (near & there).sum() > 40
        elif name == "polygon":
            rows, cols = np.nonzero(there)
            assert Outline(np.array(given)).contains_points(np.column_stack([rows, cols])).sum() > 100
    assert seen == {"indices", "pixels", "polygon", "nearest", "box", "radius"}

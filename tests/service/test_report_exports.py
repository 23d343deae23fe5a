"""The report as an export of the service: made by a worker from what is stored, spectra left alone."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from specimap_core.export.formats import KINDS, FileFormat
from specimap_core.report.document import write_document
from specimap_workers import exports
from specimap_workers.job import JobRun
from specimap_workers.workspaces import Workspace, Workspaces
from tests.support.document_scene import Page, folder_of, full_report
from tests.support.export_scene import address, make
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def client(service: Running) -> httpx.Client:
    return service.client()


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


def with_photos(service: Running, result: Result, folder: Path) -> None:
    """Give a stored result the report and the photos of a whole run."""
    report = full_report(result.cloud.n_points)
    for made in (result.local, folder_of(folder, report)):
        (made / "report.json").write_text(report.text(), encoding="utf-8")
    for name in ("report.json", "photos.jpg"):
        data = (folder / name).read_bytes()
        (result.local / name).write_bytes(data)
        service.storage.put(f"{result.prefix}/{name}", data)


def made(service: Running, client: httpx.Client, result: Result, format: str) -> httpx.Response:
    asked = client.post(address(result, format))
    assert asked.status_code == 202
    make(service, asked.json()["id"])
    described = client.get(address(result, format)).json()
    assert (described["state"], described["error"]) == ("succeeded", None), described
    return client.get(described["links"]["content"])


@pytest.mark.slow
def test_round_trip(service: Running, client: httpx.Client, result: Result, tmp_path: Path) -> None:
    with_photos(service, result, tmp_path / "whole")
    answer = made(service, client, result, "html")
    assert answer.headers["content-type"].startswith("text/html")
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["content-disposition"] == f'attachment; filename="{result.cloud_id}.report.html"'
    own = write_document(result.local, tmp_path / "own.html", "html")
    assert answer.content == own.read_bytes()
    assert any(media == "image/jpeg" for media, _ in Page(answer.text).pictures())
    pdf = made(service, client, result, "pdf")
    assert pdf.headers["content-type"] == KINDS[FileFormat.PDF].media_type == "application/pdf"
    assert pdf.content == write_document(result.local, tmp_path / "own.pdf", "pdf").read_bytes()


@pytest.mark.slow
def test_a_result_of_an_older_version(service: Running, client: httpx.Client, result: Result) -> None:
    service.storage.delete(f"{result.prefix}/preview.png")
    page = Page(made(service, client, result, "html").text)
    assert "did not keep the corners" in page.said
    assert len(page.images) == 6


@pytest.mark.slow
def test_spectra_are_not_fetched(
    service: Running, client: httpx.Client, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    inner = exports._make

    def watched(workspaces: Workspaces, workspace: Workspace, *arguments: object) -> None:
        seen.extend(str(path.relative_to(workspace.given)) for path in workspace.given.rglob("*") if path.is_file())
        inner(workspaces, workspace, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(exports, "_make", watched)
    made(service, client, result, "html")
    assert "cloud.zarr/sigma_mm/zarr.json" in seen
    assert [name for name in seen if "spectra" in name] == ["cloud.zarr/spectra/zarr.json"]


@pytest.mark.slow
def test_a_stored_report_that_is_damaged(service: Running, client: httpx.Client, result: Result) -> None:
    service.storage.put(f"{result.prefix}/report.json", b"{}")
    asked = client.post(address(result, "pdf"))
    make(service, asked.json()["id"])
    described = client.get(address(result, "pdf")).json()
    assert (described["state"], described["error"]["code"]) == ("failed", "not_found")
    assert str(service.settings.scratch) not in json.dumps(described)


@pytest.mark.slow
def test_the_api_draws_nothing() -> None:
    code = "import sys, specimap_service.app\nprint([m for m in ('matplotlib', 'reportlab') if m in sys.modules])"
    described = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert described.stdout.strip() == "[]"


@pytest.mark.parametrize("kept", [True, False])
def test_workers_publish_the_photos_where_there_are_some(
    service: Running, result: Result, tmp_path: Path, kept: bool
) -> None:
    out = shutil.copytree(result.local, tmp_path / "out")
    if kept:
        (out / "photos.jpg").write_bytes(b"tiles")
    run = JobRun.__new__(JobRun)
    run._storage, run._out = service.storage, out
    run._publish("jobs/job_of_this_test/register/one")
    stored = {Path(item.key).name for item in service.storage.list("jobs/job_of_this_test")}
    assert {"report.json", "mesh.ply", "preview.png"} <= stored
    assert ("photos.jpg" in stored) == kept

"""``specimap serve``, ``worker`` and ``demo`` as a person starts them."""

from __future__ import annotations

import signal
from pathlib import Path

import httpx
import numpy as np
import pytest

from specimap_client import Client
from specimap_core.cloud import Cloud
from specimap_core.report.model import Report
from tests.support.plain_http import NO_TLS
from tests.support.scenes import OnDisk
from tests.support.serve_scene import running
from tests.support.worker_scene import processes_of, until

pytestmark = [pytest.mark.slow, pytest.mark.waits]


def test_first_start_tells_address_and_key_and_the_second_only_the_address(tmp_path: Path) -> None:
    with running(tmp_path / "data") as first:
        url, key = first.printed("Specimap listens on "), "spk_" + first.printed("spk_")
        assert url.startswith("http://127.0.0.1:")
        with Client(url, key) as client:
            assert [k.name for k in client.keys.list()] == ["administrator"]
        first.process.send_signal(signal.SIGTERM)
        assert first.process.wait(20) == 0
        assert not processes_of(["specimap_workers", str(first.process.pid)])
    assert (tmp_path / "data").stat().st_mode & 0o077 == 0
    with running(tmp_path / "data") as second:
        url = second.printed("Specimap listens on ")
        until(
            lambda: httpx.get(f"{url}/readyz", trust_env=False, verify=NO_TLS).json()["workers"] == 1, 20, "the worker"
        )
        with Client(url, key) as client:
            assert list(client.jobs.list()) == []
        assert not any(line.startswith("spk_") for line in second.lines)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("SPECIMAP_PORT", "ninety", "SPECIMAP_PORT"),
        ("SPECIMAP_PROT", "80", "SPECIMAP_PROT"),
        ("SPECIMAP_STORAGE", "ftp://elsewhere", "SPECIMAP_STORAGE"),
        ("SPECIMAP_DATABASE_URL", "mysql://elsewhere", "SPECIMAP_DATABASE_URL"),
    ],
)
def test_a_wrong_setting_stops_the_start_with_a_sentence(tmp_path: Path, name: str, value: str, word: str) -> None:
    with running(tmp_path, **{name: value}) as refused:
        assert refused.process.wait(20) == 2
        until(lambda: refused.lines, 5, "a sentence")
        text = "".join(refused.lines)
        assert word in text
        assert "Traceback" not in text


def test_a_port_that_is_taken_stops_the_start(tmp_path: Path) -> None:
    with running(tmp_path / "one", "serve", "--no-worker") as first:
        port = first.printed("Specimap listens on ").rsplit(":", 1)[1]
        with running(tmp_path / "two", SPECIMAP_PORT=port) as second:
            assert second.process.wait(20) == 2
            assert "SPECIMAP_PORT" in "".join(second.lines)


def test_no_job_is_lost_when_everything_is_killed_at_once(tmp_path: Path, small: OnDisk) -> None:
    with running(tmp_path / "data") as first:
        url, key = first.printed("Specimap listens on "), "spk_" + first.printed("spk_")
        with Client(url, key) as client:
            acquisition = client.acquisitions.create("S1")
            client.acquisitions.upload(acquisition, photos=sorted(small.photos.glob("*.jpg")), cube=small.header)
            jobs = [client.jobs.submit(acquisition, method=method) for method in ("camera", "homography")]
            until(lambda: client.jobs.get(jobs[0]).stage == "adjust", 60, "the second stage")
        first.process.kill()
        first.process.wait(10)
        until(lambda: not processes_of(["specimap_workers", str(first.process.pid)]), 5, "the worker's end")
    with running(tmp_path / "data") as second, Client(second.printed("Specimap listens on "), key) as client:
        ended = [client.jobs.wait(job, timeout=120) for job in jobs]
        assert [job.state for job in ended] == ["succeeded"] * 2
        began = [e for e in client.jobs.events(jobs[0]) if e.type == "progress" and e.data["progress"] == 0]
        assert [e.data["stage"] for e in began].count("reconstruct") == 1
        for job in ended:
            assert job.cloud_id is not None
            assert client.clouds.get(job.cloud_id).points > 1000


def test_demo_runs_samples_through_a_service(tmp_path: Path, small: OnDisk) -> None:
    browser, opened = tmp_path / "browser", tmp_path / "opened"
    browser.write_text(f'#!/bin/sh\nprintf %s "$1" > {opened}\n')
    browser.chmod(0o755)
    arguments = ("demo", "--out", str(tmp_path / "out"), "--samples", str(small.folder), "--open")
    with running(tmp_path / "unused", *arguments, BROWSER=f"{browser} %s") as demo:
        link = demo.printed("The result in 3D: ", 180)
        until(opened.exists, 10, "the browser")
        assert opened.read_text() == link
        url, token = link.split("/#/shared/")
        with httpx.Client(base_url=url, headers={"Specimap-Page": "1"}, trust_env=False) as visitor:
            cloud_id = visitor.post("/v1/session", json={"share": token}).raise_for_status().json()["cloud_id"]
            assert visitor.get(f"/v1/clouds/{cloud_id}").json()["points"] > 1000
            assert visitor.get("/v1/jobs").status_code in (403, 404)
        demo.process.send_signal(signal.SIGINT)
        demo.process.wait(40)
    out, text = tmp_path / "out", "".join(demo.lines)
    report = Report.model_validate_json((out / "report.json").read_text("utf-8"))
    assert 0.001 < report.corner_3d_mm.median < 0.1
    cloud = Cloud.open(out / "cloud.zarr")
    assert cloud.n_points == report.coverage.points
    assert float(np.abs(cloud.spectra([0, 1])).max()) > 0.01
    assert (out / "mesh.ply").stat().st_size > 100_000
    for word in ("14 of 14 files accepted", "4 register", "report.json", "in 3D"):
        assert word in text
    assert not processes_of([str(out / "service")])

"""The client against a running service: acquisitions, jobs, keys, errors."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import httpx
import numpy as np
import pytest

import specimap_client as sc
from specimap_client import _tus
from specimap_client._retries import Retries
from specimap_infra.jobs import claim, finish, log, report_progress
from tests.support.client_scene import Live, connect
from tests.support.job_scene import EXECUTOR, acquisition
from tests.support.places import SAMPLES
from tests.support.plain_http import NO_TLS

# ---- acquisitions -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_acquisition_is_uploaded_and_judged(live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_tus, "CHUNK", 64 * 1024)
    text = tmp_path / "notes.jpg"
    text.write_text("no photo")
    photos = [*sorted((SAMPLES / "rgb").glob("*.jpg"))[:2], text]
    heard: list[sc.Progress] = []
    acquisition = live.client.acquisitions.create("S26-1042", accession_number="A.7", notes="zweimal gemessen: µ")
    files = live.client.acquisitions.upload(
        acquisition, photos=photos, cube=SAMPLES / "hsi" / "hsi.hdr", progress=heard.append, resume_file=tmp_path / "r"
    )
    assert [file.role for file in files] == ["photo", "photo", "photo", "cube", "cube"]
    assert [file.refused for file in files] == [False, False, True, False, False]
    assert files[2].judgement["code"] == "photo_unreadable"
    assert files[2].reason
    assert files[2].advice
    assert [file.name for file in files[3:]] == ["hsi.hdr", files[4].name]
    assert heard[-1].total_sent == heard[-1].total_size == sum(file.size for file in files)
    now = live.client.acquisitions.get(acquisition)
    assert (now.files.photos, now.files.refused, now.files.cube) == (2, 1, True)
    assert not now.ready
    assert now.missing
    assert now.notes == "zweimal gemessen: µ"
    assert {file.id for file in live.client.acquisitions.files(acquisition)} == {file.id for file in files}
    with pytest.raises(sc.Conflict) as caught:
        live.client.jobs.submit(acquisition)
    assert caught.value.code == "upload_incomplete"
    assert caught.value.details["missing"] == list(now.missing)
    live.client.acquisitions.delete_file(acquisition, files[2])
    assert live.client.acquisitions.get(acquisition).files.refused == 0
    live.client.acquisitions.delete(acquisition)
    with pytest.raises(sc.NotFound):
        live.client.acquisitions.get(acquisition)


def test_upload_goes_on_after_breaks_of_the_real_connection(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_tus, "CHUNK", 32 * 1024)
    photo = sorted((SAMPLES / "rgb").glob("*.jpg"))[0]

    class Shaky(httpx.HTTPTransport):
        """Every third chunk or answer is lost."""

        count = 0

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            if request.method != "PATCH":
                return super().handle_request(request)
            self.count += 1
            if self.count % 3 == 1:
                raise httpx.WriteError("cut before", request=request)
            answer = super().handle_request(request)
            if self.count % 3 == 2:
                answer.close()
                raise httpx.ReadError("cut after", request=request)
            return answer

    shaky = Shaky()
    retries = Retries(attempts=5, first_s=0.01)
    acquisition = live.client.acquisitions.create("S26-1043")
    with sc.Client(live.service.url, live.service.key(), transport=shaky, retries=retries) as client:
        (file,) = client.acquisitions.upload(acquisition, photos=[photo])
    assert shaky.count > photo.stat().st_size / _tus.CHUNK + 1
    assert (file.size, file.refused) == (photo.stat().st_size, False)


def test_lists_are_filtered_and_paged(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    made = [live.client.acquisitions.create(f"page-{i}").id for i in range(5)]
    listed = [acquisition.id for acquisition in live.client.acquisitions.list()]
    assert listed[:5] == made[::-1]
    (one,) = live.client.acquisitions.list(specimen_id="page-3")
    assert one.id == made[3]
    later = live.client.acquisitions.list(created_after=one.created_at)
    assert [acquisition.id for acquisition in later] == [made[4], made[3]]


# ---- jobs and keys ------------------------------------------------------------------------------------


def test_finished_job_has_a_report(live: Live) -> None:
    job = live.client.jobs.wait(live.result.job_id)
    assert job.cloud_id == live.result.cloud_id
    report = live.client.jobs.report(job)
    assert report.corner_3d_mm.median == 0.1
    assert report["corner_3d_mm"] == {"median": 0.1, "q1": 0.05, "q3": 0.15, "n": 16}
    assert report.photos.used[0] == "photo-0001.jpg"
    assert report.raw["cube_camera"]["focal_px"] == 1200
    assert job.id in {other.id for other in live.client.jobs.list(acquisition=live.result.acquisition_id)}
    assert list(live.client.jobs.log(job)) == []


def test_job_is_submitted_followed_and_run_again(live: Live) -> None:
    jobs, database = live.client.jobs, live.service.database
    complete = acquisition(database)
    job = jobs.submit(complete, priority="intraoperative", idempotency_key="tablet-7", r_pc=0.25)
    assert (job.state, job.priority, job.settings["r_pc"]) == ("queued", "intraoperative", 0.25)
    assert jobs.submit(complete, priority="intraoperative", idempotency_key="tablet-7", r_pc=0.25).id == job.id
    with pytest.raises(sc.Conflict) as caught:
        jobs.submit(complete, idempotency_key="tablet-7")
    assert caught.value.code == "idempotency_conflict"
    heard: list[sc.Job] = []
    running = threading.Event()

    def listen(now: sc.Job) -> None:
        heard.append(now)
        running.set()

    def work() -> None:
        assert running.wait(30)
        with database.session() as session:
            assert claim(session, job.id, EXECUTOR)
        for share in (0.0, 0.5, 1.0):
            with database.session() as session:
                report_progress(session, job.id, EXECUTOR, "render", share)
        with database.session() as session:
            log(session, job.id, EXECUTOR, "info", "photos refused", count=2)
            finish(session, job.id, EXECUTOR, "succeeded", seconds={"render": 1.0})

    worker = threading.Thread(target=work)
    worker.start()
    done = jobs.wait(job, progress=listen, timeout=60)
    worker.join(timeout=60)
    assert (done.state, done.seconds) == ("succeeded", {"render": 1.0})
    described = [(now.state, now.stage, now.progress) for now in heard]
    assert [described[0], described[-1]] == [("queued", None, 0.0), ("succeeded", "render", 1.0)]
    assert ("running", "render", 0.5) in described
    assert [event.type for event in jobs.events(job, after=2)] == ["progress", "progress", "progress", "log", "state"]
    (line,) = jobs.log(job)
    assert (line.level, line.message, line.data) == ("info", "photos refused", {"count": 2})

    again = jobs.rerun(job, r_pc=1.0)
    assert (again.rerun_of, again.settings["r_pc"], again.priority) == (job.id, 1.0, "intraoperative")
    with pytest.raises(sc.Timeout):
        jobs.wait(again, timeout=0.3)
    assert jobs.cancel(again).state == jobs.cancel(again).state == "cancelled"
    with pytest.raises(sc.JobFailed) as failed:
        jobs.wait(again)
    assert failed.value.job.state == "cancelled"
    jobs.delete(again)
    with pytest.raises(sc.NotFound):
        jobs.get(again)


def test_keys_are_made_listed_and_revoked(live: Live) -> None:
    made = live.client.keys.create("tablet 3", ["read"], rate_per_minute=600)
    with sc.Client(live.service.url, made.key, transport=httpx.HTTPTransport(verify=NO_TLS)) as reader:
        assert reader.clouds.get(live.result.cloud_id).points
        with pytest.raises(sc.Forbidden) as caught:
            reader.keys.list()
        assert caught.value.details == {"scope": "admin"}
        assert made.id in {key.id for key in live.client.keys.list()}
        live.client.keys.revoke(made)
        with pytest.raises(sc.Unauthorized):
            reader.clouds.get(live.result.cloud_id)


def test_projects_keep_apart_what_their_keys_make(live: Live) -> None:
    administrator = live.client
    project = administrator.projects.rename(administrator.projects.create("study-7"), "study-8")
    assert administrator.projects.get(project) == project
    assert [p.name for p in administrator.projects.list()] == ["default", "study-8"]
    with pytest.raises(sc.Conflict):
        administrator.projects.create("study-8")
    made = administrator.keys.create("tablet 4", ["upload", "read"], project=project)
    assert made.project_id == project.id
    assert [key.id for key in administrator.keys.list(project="study-8")] == [made.id]
    with sc.Client(live.service.url, made.key, transport=httpx.HTTPTransport(verify=NO_TLS)) as other:
        assert other.projects.list() == [project]
        with pytest.raises(sc.NotFound):
            other.clouds.get(live.result.cloud_id)
        assert not [*other.clouds.list(), *other.jobs.list(), *other.acquisitions.list()]
        own = other.acquisitions.create("SP-8")
        assert own.project_id == project.id
        with pytest.raises(sc.Forbidden) as caught:
            other.jobs.submit(acquisition(live.service.database, project=project.id), priority="intraoperative")
        assert caught.value.details == {"scope": "intraoperative"}
    assert own.id in [a.id for a in administrator.acquisitions.list(project=project)]
    assert not [*administrator.clouds.list(project=project), *administrator.jobs.list(project="study-8")]
    assert live.result.cloud_id in [cloud.id for cloud in administrator.clouds.list(project="default")]


def test_rate_limit_is_waited_for(live: Live) -> None:
    key = live.service.key(["read"], rate_per_minute=60)
    started = time.monotonic()
    with sc.Client(live.service.url, key, transport=httpx.HTTPTransport(verify=NO_TLS)) as hasty:
        for _ in range(62):
            hasty.clouds.get(live.result.cloud_id)
    assert 1.0 < time.monotonic() - started < 30


def test_errors_carry_the_correlation_id_of_the_log(live: Live) -> None:
    with connect(live.service, correlation_id="ward-7.2026-11") as client, pytest.raises(sc.NotFound) as caught:
        client.jobs.get("job_" + "0" * 26)
    assert (caught.value.code, caught.value.correlation_id) == ("not_found", "ward-7.2026-11")


def test_client_is_shared_between_threads(live: Live) -> None:
    cloud, truth = live.cloud, live.result.cloud
    wrong: list[int] = []

    def read(start: int) -> None:
        for i in range(start, start + 5):
            found = cloud.spectra(indices=[i]).values
            if not np.array_equal(found, truth.spectra([i])):
                wrong.append(i)

    threads = [threading.Thread(target=read, args=(100 * n,)) for n in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
        assert not thread.is_alive()
    assert wrong == []

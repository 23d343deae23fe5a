"""Many jobs, many workers, databases and storages that go away; several machines."""

from __future__ import annotations

import random
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from specimap_core.cloud import Cloud
from tests.support.databases import postgres_url
from tests.support.gate import Gate
from tests.support.object_store import object_store
from tests.support.scenes import Finished, OnDisk
from tests.support.service_scene import serving
from tests.support.worker_scene import QUICK, assert_all_succeed, shop, until

pytestmark = [pytest.mark.slow, pytest.mark.waits]

JOBS = 30
KILLS = 6


def test_no_job_is_lost_when_workers_are_killed_at_random(tmp_path: Path, small: OnDisk, finished: Finished) -> None:
    with postgres_url() as url, shop(tmp_path / "shop", database_url=url) as yard:
        options = {"RESULT_FOLDER": str(finished.out), "STAGE_SECONDS": "0.05"}
        acquisition = yard.acquisition(small.photos, small.header)
        ids = [yard.submit(acquisition, priority=1 + k % 9) for k in range(JOBS)]
        workers = [yard.start(QUICK, **options) for _ in range(3)]
        rng = random.Random(7)
        for _ in range(KILLS):
            time.sleep(rng.uniform(0.3, 1.5))
            victim = rng.randrange(len(workers))
            workers[victim].kill()
            workers[victim] = yard.start(QUICK, **options)
        assert_all_succeed(yard, ids)
        for job_id in ids[::10]:
            assert yard.storage.stat(f"{yard.cloud(job_id).prefix}/report.json").size > 1000


def test_urgent_jobs_come_first(tmp_path: Path, small: OnDisk, finished: Finished) -> None:
    with shop(tmp_path / "shop") as yard:
        acquisition = yard.acquisition(small.photos, small.header)
        order = [9, 5, 1, 5, 1, 9]
        ids = [yard.submit(acquisition, priority) for priority in order]
        yard.start(QUICK, RESULT_FOLDER=str(finished.out))
        for job_id in ids:
            yard.ended(job_id)
        started = sorted(ids, key=lambda job_id: str(yard.job(job_id).started_at))
        assert [order[ids.index(job_id)] for job_id in started] == [1, 1, 5, 5, 9, 9]


def test_jobs_go_on_when_the_database_is_away(tmp_path: Path, small: OnDisk, finished: Finished) -> None:
    with postgres_url() as url:
        parsed = sa.make_url(url)
        assert parsed.host is not None
        with Gate((parsed.host, parsed.port or 5432)) as gate:
            through = parsed.set(host="127.0.0.1", port=gate.port).render_as_string(hide_password=False)
            with shop(tmp_path / "shop", database_url=url) as yard:
                acquisition = yard.acquisition(small.photos, small.header)
                options = {"RESULT_FOLDER": str(finished.out), "STAGE_SECONDS": "1.5"}
                for _ in range(2):
                    yard.start(QUICK, SPECIMAP_DATABASE_URL=through, **options)
                ids = [yard.submit(acquisition) for _ in range(4)]
                until(lambda: yard.job(ids[0]).state == "running", 20, "the first start")
                gate.shut()
                time.sleep(20)
                gate.open()
                for job_id in ids:
                    job = yard.ended(job_id, 90)
                    assert (job.state, job.error) == ("succeeded", None)
                    assert yard.cloud(job_id).points > 1000


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB; skips where none can be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(folder)], capture_output=True, check=False
    )
    if done.returncode:
        pytest.skip("a disk cannot be mounted here: that takes root's rights")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_full_storage_fails_the_job_with_that_code(
    tiny_disk: Path, tmp_path: Path, small: OnDisk, finished: Finished
) -> None:
    with shop(tmp_path / "shop", storage=str(tiny_disk / "storage")) as yard:
        acquisition = yard.acquisition(small.photos, small.header)
        filler = tiny_disk / "filler"
        filler.write_bytes(b"0" * 200_000)
        while _room(filler):
            pass
        yard.start(QUICK, RESULT_FOLDER=str(finished.out))
        job_id = yard.submit(acquisition)
        job = yard.ended(job_id)
        assert job.state == "failed"
        assert job.error is not None
        assert job.error["code"] == "storage_full"
        assert not list(yard.storage.list(f"jobs/{job_id}"))
        filler.unlink()
        healthy = yard.submit(acquisition)
        ended = yard.ended(healthy)
        # The disk may be too small for the result still; half a result there is never.
        if ended.state == "succeeded":
            assert yard.storage.stat(f"{yard.cloud(healthy).prefix}/report.json").size > 1000


def _room(filler: Path) -> bool:
    """Fill the disk up; whether there was room."""
    try:
        with open(filler, "ab") as file:
            file.write(b"0" * 4096)
    except OSError:
        return False
    return True


def test_a_read_only_storage_fails_the_job_with_that_code(
    tiny_disk: Path, tmp_path: Path, small: OnDisk, finished: Finished
) -> None:
    with shop(tmp_path / "shop", storage=str(tiny_disk / "storage"), patience_seconds=3) as yard:
        acquisition = yard.acquisition(small.photos, small.header)
        yard.start(QUICK, RESULT_FOLDER=str(finished.out))
        subprocess.run(["mount", "-o", "remount,ro", str(tiny_disk)], check=True)
        job = yard.ended(yard.submit(acquisition))
        assert job.state == "failed"
        assert job.error is not None
        assert job.error["code"] == "storage_unavailable"
        subprocess.run(["mount", "-o", "remount,rw", str(tiny_disk)], check=True)


def test_two_apis_and_three_workers_on_postgresql_and_s3(
    tmp_path: Path, small: OnDisk, finished: Finished, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with postgres_url() as url, object_store("specimap") as endpoint:
        common: dict[str, Any] = {"database_url": url, "storage": "s3://specimap/site-1", "s3_endpoint": endpoint}
        with shop(tmp_path / "shop", **common) as yard:
            acquisition = yard.acquisition(small.photos, small.header)
            for k in range(3):
                yard.start(SPECIMAP_SCRATCH_DIR=str(tmp_path / f"machine-{k}"))
            ids = []
            for method in ("camera", "homography"):
                # One after the other: what the stages of the first left is taken over, whoever made it.
                ids.append(yard.submit(acquisition, method=method))
                job = yard.ended(ids[-1], 120)
                assert (job.state, job.error) == ("succeeded", None)
            with serving(tmp_path / "api-1", **common) as one, serving(tmp_path / "api-2", **common) as two:
                key = one.key()
                for api in (one, two):
                    client = api.client()
                    client.headers["Authorization"] = f"Bearer {key}"
                    for job_id in ids:
                        row = yard.cloud(job_id)
                        cloud = client.get(f"/v1/clouds/{row.id}").json()
                        assert (cloud["points"], cloud["bands"]) == (row.points, 16)
                        point = client.get(f"/v1/clouds/{row.id}/points/17").json()
                        local = tmp_path / "copies" / row.id
                        if not local.exists():
                            yard.storage.fetch(f"{row.prefix}/cloud.zarr", local)
                        expected = Cloud.open(local).spectra([17])[0]
                        assert point["spectrum"] == pytest.approx(expected.tolist(), abs=1e-4)

"""What becomes of jobs: reports, logs, reruns, deletion with all that hangs on them."""

from __future__ import annotations

from typing import Any

import pytest
import sqlalchemy as sa

from specimap_core.report.model import Report
from specimap_infra import jobs
from specimap_infra.ids import new_id
from specimap_infra.tables import Acquisition, CloudRow, Delivery, Export, JobEvent, LabelVersion
from tests.support.job_scene import EXECUTOR, acquisition, events, queued_job, row
from tests.support.service_scene import Running

SPREAD = {"mean": 0.1, "std": 0.1, "n": 4}
QUARTILES = {"median": 0.1, "q1": 0.1, "q3": 0.2, "n": 4}
REPORT: dict[str, Any] = {
    "specimap_version": "0.1.0",
    "created": "2026-11-01T00:00:00Z",
    "method": "camera",
    "backend": "colmap",
    "adjustment": "rigid",
    "marker_ids": [0, 1, 2, 3],
    "marker_ids_in_cube": [0, 1, 2, 3],
    "corner_2d_mm": SPREAD,
    "corner_3d_mm": QUARTILES,
    "leave_one_marker_out_mm": None,
    "methods": {},
    "edge_length_mm": {**SPREAD, "expected": 6.8},
    "corner_sigma_mm": 0.05,
    "reprojection_px": {"before": 1.0, "after": 0.5},
    "photos": {"given": 6, "used": [], "refused": []},
    "inliers": {"n": 16, "of": 16, "threshold_px": 3.0, "threshold_mm": 6.0},
    "coverage": {"between_markers": 1.0, "points": 10, "specimen_points": 8},
    "parallax_removed_mm": {"median": 1.0, "maximum": 2.0},
    "sigma_mm": {"median": 0.1, "p95": 0.2},
    "cube_camera": {
        "focal_px": 1000.0,
        "focal_relative_sd": 0.1,
        "distance_mm": 300.0,
        "reprojection_rms_px": 0.3,
        "roll_deg": 0.0,
        "mirrored": False,
        "markers_found_in": "band mean",
    },
    "photo_focal_px": 1000.0,
    "seconds": {"register": 2.5},
    "reused_stages": [],
    "warnings": [],
}


def succeeded(service: Running, owner: str, prefix: str | None = None) -> tuple[str, str]:
    """A job that has succeeded, with a result of one file; its id and the cloud's."""
    job_id, cloud_id = queued_job(service.database, owner), new_id("cloud")
    prefix = prefix or f"jobs/{job_id}/register/{new_id('att')}"
    service.storage.put(f"{prefix}/report.json", b"{}")
    with service.database.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
        session.add(
            CloudRow(
                id=cloud_id,
                job_id=job_id,
                acquisition_id=owner,
                prefix=prefix,
                points=10,
                bands=5,
                size=2,
                report=REPORT,
            )
        )
        jobs.finish(session, job_id, EXECUTOR, "succeeded", seconds={"register": 2.5})
    return job_id, cloud_id


def test_report_is_there_once_the_job_has_succeeded(service: Running) -> None:
    owner = acquisition(service.database)
    client = service.client(["read"])
    early = client.get(f"/v1/jobs/{queued_job(service.database, owner)}/report")
    assert (early.status_code, early.json()["code"], early.json()["details"]) == (
        409,
        "state_conflict",
        {"state": "queued"},
    )
    job_id, cloud_id = succeeded(service, owner)
    assert Report.model_validate(client.get(f"/v1/jobs/{job_id}/report").json()) == Report.model_validate(REPORT)
    job = client.get(f"/v1/jobs/{job_id}").json()
    assert (job["state"], job["cloud_id"], job["seconds"]) == ("succeeded", cloud_id, {"register": 2.5})
    assert events(service.database, job_id)[-1].data["cloud_id"] == cloud_id


def test_log_comes_in_order_and_in_pages(service: Running) -> None:
    job_id = queued_job(service.database)
    with service.database.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
        for n in range(5):
            jobs.report_progress(session, job_id, EXECUTOR, "adjust", n / 5)
            jobs.log(session, job_id, EXECUTOR, "info", f"Line {n}.", n=n)
    client = service.client(["read"])
    page = client.get(f"/v1/jobs/{job_id}/log", params={"limit": 3}).json()
    assert [(line["message"], line["data"]) for line in page["items"]] == [(f"Line {n}.", {"n": n}) for n in range(3)]
    assert [line["seq"] for line in page["items"]] == [4, 6, 8]
    rest = client.get(f"/v1/jobs/{job_id}/log", params={"after": page["next"]}).json()
    assert ([line["seq"] for line in rest["items"]], rest["next"]) == ([10, 12], None)
    assert client.get(f"/v1/jobs/job_{'0' * 26}/log").status_code == 404


def test_rerun_keeps_what_is_not_changed(service: Running) -> None:
    owner = acquisition(service.database)
    client = service.client()
    settings = {"r_pc": 0.25, "method": "homography"}
    wanted = {"acquisition_id": owner, "settings": settings, "priority": "research"}
    first = client.post("/v1/jobs", json=wanted).json()
    # What the acquisition says now does not change what the job ran with.
    with service.database.session() as session:
        session.get_one(Acquisition, owner).edge_mm = 9.0
    same = client.post(f"/v1/jobs/{first['id']}/rerun")
    assert same.status_code == 202
    assert same.headers["location"] == f"/v1/jobs/{same.json()['id']}"
    assert {name: same.json()[name] for name in ("settings", "priority", "rerun_of", "acquisition_id")} == {
        "settings": first["settings"],
        "priority": "research",
        "rerun_of": first["id"],
        "acquisition_id": owner,
    }
    headers = {"Idempotency-Key": "again"}
    change = {"settings": {"r_reg": 1.0}, "priority": "routine"}
    changed = client.post(f"/v1/jobs/{first['id']}/rerun", json=change, headers=headers)
    assert changed.json()["settings"] == {**first["settings"], "r_reg": 1.0}
    assert changed.json()["priority"] == "routine"
    again = client.post(f"/v1/jobs/{first['id']}/rerun", json=change, headers=headers)
    assert (again.status_code, again.json()["id"]) == (200, changed.json()["id"])
    other = client.post(f"/v1/jobs/{same.json()['id']}/rerun", json=change, headers=headers)
    assert other.json()["code"] == "idempotency_conflict"
    assert client.post(f"/v1/jobs/job_{'0' * 26}/rerun").status_code == 404


@pytest.mark.parametrize("final", ["succeeded", "failed", "cancelled"])
def test_deleted_job_leaves_nothing(service: Running, final: str) -> None:
    owner = acquisition(service.database)
    client = service.client()
    job_id = client.post("/v1/jobs", json={"acquisition_id": owner}).json()["id"]
    refused = client.delete(f"/v1/jobs/{job_id}")
    assert (refused.status_code, refused.json()["details"]) == (409, {"state": "queued"})
    if final == "cancelled":
        client.post(f"/v1/jobs/{job_id}/cancel")
    else:
        with service.database.session() as session:
            jobs.claim(session, job_id, EXECUTOR)
            jobs.finish(session, job_id, EXECUTOR, final)  # type: ignore[arg-type]
    service.storage.put(f"jobs/{job_id}/register/att_1/report.json", b"1")
    with service.database.session() as session:
        session.add(Delivery(id=new_id("dlv"), job_id=job_id, state="pending"))
    assert service.client(("read", "upload", "label")).delete(f"/v1/jobs/{job_id}").status_code == 403
    assert client.delete(f"/v1/jobs/{job_id}").status_code == 204
    assert client.get(f"/v1/jobs/{job_id}").status_code == client.delete(f"/v1/jobs/{job_id}").status_code == 404
    assert list(service.storage.list(f"jobs/{job_id}")) == []
    with service.database.session() as session:
        for table in (JobEvent, Delivery):
            assert session.scalar(sa.select(sa.func.count()).select_from(table)) == 0
    assert service.app.state.context.queue.list_workflows() == []
    assert client.get("/v1/audit", params={"target": job_id}).json()["items"][0]["action"] == "job.delete"


def test_deletion_takes_the_results_files_and_spares_those_of_others_and_of_the_acquisition(service: Running) -> None:
    owner = acquisition(service.database)
    job_id, cloud_id = succeeded(service, owner)
    with service.database.session() as session:
        made = {"created_by": "key_test"}
        session.add(
            LabelVersion(
                cloud_id=cloud_id,
                name="tumour",
                version=1,
                kind="class",
                classes=[],
                made_by={},
                storage_prefix=f"clouds/{cloud_id}/labels/tumour/v1",
                sha256="0",
                **made,
            )
        )
        export_id = new_id("exp")
        session.add(
            Export(
                id=export_id,
                cloud_id=cloud_id,
                format="ply",
                state="succeeded",
                correlation_id="",
                storage_key=f"exports/{export_id}/cloud.ply",
                **made,
            )
        )
    stage = f"acquisitions/{owner}/stages/att_1.npz"
    for key in (f"clouds/{cloud_id}/labels/tumour/v1/zarr.json", f"exports/{export_id}/cloud.ply", stage):
        service.storage.put(key, b"1")
    other, _ = succeeded(service, owner)
    client = service.client()
    assert client.delete(f"/v1/jobs/{job_id}").status_code == 204
    left = [file.key for top in ("jobs", "clouds", "exports", "acquisitions") for file in service.storage.list(top)]
    assert len(left) == 2
    assert left[0].startswith(f"jobs/{other}/")
    # For the next run on the same files.
    assert left[1] == stage
    assert client.get(f"/v1/jobs/{other}/report").status_code == 200
    assert client.delete(f"/v1/jobs/{other}").status_code == 204
    assert list(service.storage.list("jobs")) == []


def test_cancel_counts_where_the_engine_cannot_be_told(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    client = service.client()
    job_id = client.post("/v1/jobs", json={"acquisition_id": acquisition(service.database)}).json()["id"]

    def away(_: str) -> None:
        raise sa.exc.OperationalError("", None, OSError("gone"))

    monkeypatch.setattr(service.app.state.context.queue, "cancel_workflow", away)
    assert client.post(f"/v1/jobs/{job_id}/cancel").status_code == 202
    assert row(service.database, job_id).state == "cancelled"

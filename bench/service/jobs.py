"""Jobs of the sample through the service with a worker: what they take besides their stages, and how long they wait."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

from bench.sample import SAMPLE
from bench.service.options import Options
from bench.service.serving import serving
from bench.service.sheet import Sheet, reached
from specimap_client import Client, Job

OVERHEAD_TARGET_S = 2.0
FIRST_R_PC = 0.6
"""Grid of the first rerun; each further one has another, so that only the later stages have something to do."""
NAMES = {"job": "whole job", "rerun": "rerun with another grid (stages 3 and 4)"}


def bench_jobs(work: Path, options: Options) -> dict[str, Any]:
    """Run jobs one after the other, each of an acquisition of its own, then reruns of the last one."""
    figures: dict[str, Any] = {"runs": {"job": [], "rerun": []}}
    with serving(work / "jobs", worker=True) as served, served.client() as client:
        _warm_up(client)
        for number in range(options.jobs):
            acquisition = client.acquisitions.create(f"bench-{number}")
            start = time.perf_counter()
            files = client.acquisitions.upload(
                acquisition, photos=sorted((SAMPLE / "rgb").glob("*.jpg")), cube=SAMPLE / "hsi" / "hsi.hdr"
            )
            upload_s = time.perf_counter() - start
            if any(file.refused for file in files):
                raise RuntimeError("files of the sample were refused")
            start = time.perf_counter()
            job = client.jobs.submit(acquisition)
            submit_s = time.perf_counter() - start
            job = client.jobs.wait(job)
            heard_s = time.perf_counter() - start
            figures["runs"]["job"].append(_run(client, job, submit_s=submit_s, heard_s=heard_s, upload_s=upload_s))
        for number in range(options.jobs):
            start = time.perf_counter()
            rerun = client.jobs.rerun(job, r_pc=FIRST_R_PC + number / 100)
            submit_s = time.perf_counter() - start
            rerun = client.jobs.wait(rerun)
            heard_s = time.perf_counter() - start
            figures["runs"]["rerun"].append(_run(client, rerun, submit_s=submit_s, heard_s=heard_s))
    return figures


def sheet_jobs(figures: dict[str, Any]) -> list[Sheet]:
    """Seconds, medians and the worst."""
    sheet = Sheet(
        "Jobs of the sample (24 photos, cube 464 x 432 x 16) through the service, one at a time, median s",
        ("job", "runs", "submission to answer", "waited", "stages", "overhead", "worst overhead", "wanted", "met"),
    )
    for kind, runs in figures["runs"].items():
        worst = max(run["overhead_s"] for run in runs)
        cells = (_median(runs, name) for name in ("heard_s", "wait_s", "stages_s", "overhead_s"))
        sheet.rows.append(
            (
                NAMES[kind],
                str(len(runs)),
                *(f"{value:.2f}" for value in cells),
                f"{worst:.2f}",
                f"< {OVERHEAD_TARGET_S:.0f} s",
                reached(worst, OVERHEAD_TARGET_S, least=False),
            )
        )
    uploaded = _median(figures["runs"]["job"], "upload_s")
    sheet.notes.append(
        "Waited: from submission to the worker's start. Overhead: from there to the end, less the stages that ran. "
        f"The 26 files of one acquisition are uploaded, hashed and judged in {uploaded:.1f} s."
    )
    return [sheet]


def _run(client: Client, job: Job, **seconds: float) -> dict[str, Any]:
    assert job.started_at is not None
    assert job.finished_at is not None
    # Their seconds are those of the run that made what was found.
    reused = client.jobs.report(job).raw["reused_stages"]
    stages = {stage: took for stage, took in job.seconds.items() if stage not in reused}
    running = (job.finished_at - job.started_at).total_seconds()
    return {
        "stages": stages,
        "reused": list(reused),
        "stages_s": round(sum(stages.values()), 3),
        "overhead_s": round(running - sum(stages.values()), 3),
        "wait_s": round((job.started_at - job.created_at).total_seconds(), 3),
        **{name: round(value, 3) for name, value in seconds.items()},
    }


def _warm_up(client: Client) -> None:
    """Wait until the worker takes jobs: the time that it needs to start is no queue."""
    acquisition = client.acquisitions.create("warm-up")
    client.acquisitions.upload(
        acquisition, photos=sorted((SAMPLE / "rgb").glob("*.jpg")), cube=SAMPLE / "hsi" / "hsi.hdr"
    )
    client.jobs.wait(client.jobs.submit(acquisition))


def _median(runs: list[dict[str, Any]], name: str) -> float:
    return float(statistics.median(run[name] for run in runs))

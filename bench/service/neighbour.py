"""One key that asks for as much as it can, and what another waits meanwhile: for a job's status, a photo's verdict."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from bench.sample import SAMPLE
from bench.service.hostile import KINDS, run_hostile
from bench.service.options import Options
from bench.service.scene import put_result
from bench.service.serving import Served, serving
from bench.service.sheet import Sheet, reached
from bench.service.wire import Connection, request
from specimap_core.atomic import remove

SECONDS = 15.0
SETTLE_SECONDS = 3.0
"""How long the hostile key goes on before anything is measured: its queue is full then."""
PAUSE_SECONDS = 0.005
PATIENCE_SECONDS = 120
STATUS_TARGET_MS = 100.0
VERDICT_TARGET_S = 2.0
NAMES = {"alone": "nobody", **{name: kind.words for name, kind in KINDS.items()}}


def bench_neighbour(work: Path, options: Options) -> dict[str, Any]:
    """Measure another key's requests alone, then beside each kind of hostile key, ``repeats`` times."""
    figures: dict[str, Any] = {"seconds": SECONDS, "runs": {name: [] for name in NAMES}}
    for k in range(options.repeats):
        for name in NAMES:
            # A service of its own: what one hostile key has left in the queues would count as a second one.
            folder = work / f"neighbour-{name}-{k}"
            with serving(folder) as served:
                result = put_result(served, work)
                figures |= {"points": result.cloud.n_points, "bands": result.cloud.bands}
                _measured(served, result.cloud_id, 2.0)
                with _beside(served, name, result.cloud_id) as answers:
                    run = _measured(served, result.cloud_id, SECONDS)
                figures["runs"][name].append(run | {"hostile": dict(answers)})
            remove(folder)
    return figures


def sheet_neighbour(figures: dict[str, Any]) -> list[Sheet]:
    """Waits of the other key, the worst of all runs."""
    sheet = Sheet(
        f"Waits of a key beside a hostile one ({figures['points']} points x {figures['bands']} bands), worst run",
        ("hostile key", "status p50 ms", "p99 ms", "wanted", "met", "photo's verdict s", "worst", "wanted", "met"),
    )
    for name, runs in figures["runs"].items():
        p99 = max(run["status_p99_ms"] for run in runs)
        worst = max(run["verdict_worst_s"] for run in runs)
        sheet.rows.append(
            (
                NAMES[name],
                f"{max(run['status_p50_ms'] for run in runs):.1f}",
                f"{p99:.1f}",
                f"<= {STATUS_TARGET_MS:.0f}",
                reached(p99, STATUS_TARGET_MS, least=False),
                f"{max(run['verdict_median_s'] for run in runs):.2f}",
                f"{worst:.2f}",
                f"<= {VERDICT_TARGET_S:.0f}",
                reached(worst, VERDICT_TARGET_S, least=False),
            )
        )
    answered: Counter[str] = sum((Counter(run["hostile"]) for run in _hostile_runs(figures)), Counter())
    told = ", ".join(f"{count} times {status}" for status, count in sorted(answered.items()))
    sheet.notes.append(f"Both clients run on the same cores. The hostile key was answered {told}.")
    return [sheet]


def _hostile_runs(figures: dict[str, Any]) -> list[dict[str, Any]]:
    return [run for name, runs in figures["runs"].items() if name != "alone" for run in runs]


@contextmanager
def _beside(served: Served, name: str, cloud_id: str) -> Iterator[Counter[str]]:
    """Let a key of its own, in a process of its own, do what a kind does; the answers by status, once it has ended."""
    answers: Counter[str] = Counter()
    if name == "alone":
        yield answers
        return
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=run_hostile, args=(name, served.url, _key(served, name), cloud_id, there))
    process.start()
    try:
        if not here.poll(PATIENCE_SECONDS) or here.recv() != "ready":
            raise RuntimeError("the hostile client does not start")
        time.sleep(SETTLE_SECONDS)
        yield answers
        if not process.is_alive():
            raise RuntimeError("the hostile client has ended")
        here.send("stop")
        if not here.poll(PATIENCE_SECONDS):
            raise RuntimeError("the hostile client does not stop")
        answers.update(here.recv())
    finally:
        process.kill()
        process.join()


def _key(served: Served, name: str) -> str:
    answer = httpx.post(
        f"{served.url}/v1/keys",
        json={"name": name, "scopes": ["upload", "read"]},
        headers={"Authorization": served.bearer},
        timeout=PATIENCE_SECONDS,
        trust_env=False,
    )
    answer.raise_for_status()
    return str(answer.json()["key"])


def _measured(served: Served, cloud_id: str, seconds: float) -> dict[str, Any]:
    """The waits of one key that asks for a job's status again and again, and sends a photo at a time beside that."""
    key = _key(served, "other")
    verdicts: list[float] = []
    end = time.perf_counter() + seconds
    with httpx.Client(
        base_url=served.url, headers={"Authorization": f"Bearer {key}"}, timeout=PATIENCE_SECONDS, trust_env=False
    ) as client:
        job_id = client.get(f"/v1/clouds/{cloud_id}").raise_for_status().json()["job_id"]
        acquisition = client.post("/v1/acquisitions", json={"specimen_id": "other"}).raise_for_status().json()["id"]
        photos = sorted((SAMPLE / "rgb").glob("*.jpg"))

        def send_photos() -> None:
            while not verdicts or time.perf_counter() < end:
                data = photos[len(verdicts) % len(photos)].read_bytes() + b"%d" % len(verdicts)
                start = time.perf_counter()
                answer = client.post(
                    f"/v1/acquisitions/{acquisition}/files", data={"role": "photo"}, files={"file": ("x.jpg", data)}
                )
                answer.raise_for_status()
                verdicts.append(time.perf_counter() - start)
                time.sleep(0.2)

        sending = threading.Thread(target=send_photos)
        sending.start()
        waits = []
        connection = Connection(served.address)
        asked = request(served.address, f"/v1/jobs/{job_id}", {"Authorization": f"Bearer {key}"})
        while time.perf_counter() < end:
            start = time.perf_counter()
            connection.exchange(asked)
            waits.append(time.perf_counter() - start)
            time.sleep(PAUSE_SECONDS)
        connection.close()
        sending.join()
    if not verdicts:
        raise RuntimeError("no photo was judged")
    p50, p99 = np.percentile(waits, [50, 99]) * 1e3
    return {
        "status_requests": len(waits),
        "status_p50_ms": round(float(p50), 2),
        "status_p99_ms": round(float(p99), 2),
        "status_worst_ms": round(max(waits) * 1e3, 2),
        "verdicts": len(verdicts),
        "verdict_median_s": round(float(np.median(verdicts)), 3),
        "verdict_worst_s": round(max(verdicts), 3),
    }

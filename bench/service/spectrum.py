"""One spectrum over HTTP: how long it takes, and how many a second, for 1, 16 and 64 clients."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.service.options import Options
from bench.service.peer import NO_NGINX, NO_TILED, nginx, nginx_version, tiled, tiled_version
from bench.service.scene import put_result
from bench.service.serving import Served, serving
from bench.service.sheet import NONE, Sheet, reached
from bench.service.wire import Address, Connection, load, request

CLIENTS = (1, 16, 64)
SECONDS = 5.0
WARM_SECONDS = 1.0
ASKED = 2048
"""Different points that are asked for in turn, all over the cloud."""
P50_TARGET_MS = 5.0
RATE_TARGET = 300.0
NAMES = {
    "point": "`GET points/{i}`, JSON",
    "spectra": "`POST spectra`, one index, NumPy",
    "tiled": "Tiled, one row of `spectra`, bytes",
    "file": "nginx, the same JSON as files",
}


def bench_spectrum(work: Path, options: Options) -> dict[str, Any]:
    """Load the service, Tiled with the same array, and nginx with the service's answers as files."""
    with serving(work / "spectrum") as served:
        result = put_result(served, work)
        points = np.random.default_rng(0).integers(0, result.cloud.n_points, ASKED).tolist()
        headers = {"Authorization": served.bearer}
        npy = headers | {"Accept": "application/x-npy", "Content-Type": "application/json"}
        asked = {
            "point": [request(served.address, f"{result.path}/points/{i}", headers) for i in points],
            "spectra": [
                request(served.address, f"{result.path}/spectra", npy, "POST", b'{"select":{"indices":[%d]}}' % i)
                for i in points
            ],
        }
        figures: dict[str, Any] = {
            "points": result.cloud.n_points,
            "bands": result.cloud.bands,
            "client": "one process, raw sockets, epoll",
            "nginx": nginx_version(),
            "tiled": tiled_version(),
            "bytes": {name: _bytes(served.address, requests[0]) for name, requests in asked.items()},
            "runs": {},
        }
        for name, requests in asked.items():
            figures["runs"][name] = _levels(served.address, requests, options.repeats, served)
        _keep_answers(served, [f"{result.path}/points/{i}" for i in points], work / "answers")
        with tiled(result.group, work / "tiled") as other:
            if other is not None:
                octets = {"Accept": "application/octet-stream"}
                rows = [request(other, f"/api/v1/array/full/cloud/spectra?slice={i},:", octets) for i in points]
                figures["bytes"]["tiled"] = _bytes(other, rows[0])
                figures["runs"]["tiled"] = _levels(other, rows, options.repeats, None)
    with nginx(work / "answers", work / "nginx-spectrum") as peer:
        if peer is not None:
            files = [request(peer.address, f"/{number}.json") for number in range(ASKED)]
            figures["bytes"]["file"] = _bytes(peer.address, files[0])
            figures["runs"]["file"] = _levels(peer.address, files, options.repeats, None)
    return figures


def sheet_spectrum(figures: dict[str, Any]) -> list[Sheet]:
    """Speed by clients, and the targets."""
    sheet = Sheet(
        f"One spectrum over HTTP, {figures['points']} points x {figures['bands']} bands, fastest run",
        ("request", "bytes", "clients", "p50 ms", "p99 ms", "requests/s", "CPU ms each"),
    )
    for name, levels in figures["runs"].items():
        for clients, runs in levels.items():
            best = max(runs, key=lambda run: run["per_second"])
            sheet.rows.append(
                (
                    NAMES[name],
                    str(figures["bytes"][name]),
                    clients,
                    f"{best['p50_ms']:.2f}",
                    f"{best['p99_ms']:.2f}",
                    f"{best['per_second']:.0f}",
                    f"{best['cpu_ms']:.2f}" if "cpu_ms" in best else NONE,
                )
            )
    sheet.notes.append("The client (one process, raw sockets) runs on the same cores; CPU is the API process's alone.")
    if figures["nginx"] is None:
        sheet.notes.append(NO_NGINX)
    if figures["tiled"] is None:
        sheet.notes.append(NO_TILED)
    levels = figures["runs"]["point"]
    p50 = min(run["p50_ms"] for run in levels["1"])
    rate = max(run["per_second"] for run in levels["64"])
    targets = Sheet("", ("target", "reached", "wanted", "met"))
    targets.rows = [
        ("p50 of one client", f"{p50:.2f} ms", f"<= {P50_TARGET_MS:.0f} ms", reached(p50, P50_TARGET_MS, least=False)),
        (
            "spectra a second, 64 clients",
            f"{rate:.0f}",
            f">= {RATE_TARGET:.0f}",
            reached(rate, RATE_TARGET, least=True),
        ),
    ]
    return [sheet, targets]


def _levels(address: Address, requests: list[bytes], repeats: int, served: Served | None) -> dict[str, Any]:
    """Figures by number of clients; each run after a warm-up of its own."""
    found: dict[str, Any] = {}
    for clients in CLIENTS:
        runs = found[str(clients)] = []
        for _ in range(repeats):
            load(address, requests, clients, WARM_SECONDS)
            before = served.cpu_seconds() if served else 0.0
            run = load(address, requests, clients, SECONDS).as_dict()
            if served is not None:
                run["cpu_ms"] = round(1e3 * (served.cpu_seconds() - before) / run["requests"], 3)
            runs.append(run)
    return found


def _bytes(address: Address, sent: bytes) -> int:
    connection = Connection(address)
    try:
        return connection.exchange(sent)
    finally:
        connection.close()


def _keep_answers(served: Served, paths: list[str], folder: Path) -> None:
    """The service's answers as files, for the peer to serve."""
    folder.mkdir()
    connection = Connection(served.address)
    for number, path in enumerate(paths):
        content = connection.content(request(served.address, path, {"Authorization": served.bearer}))
        (folder / f"{number}.json").write_bytes(content)
    connection.close()

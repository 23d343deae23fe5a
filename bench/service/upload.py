"""Cubes up by resumable upload and down again, compared with nginx; and the memory of the API's process meanwhile."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from pathlib import Path
from typing import Any

from bench.service.options import Options
from bench.service.peer import NO_NGINX, Nginx, nginx, nginx_version
from bench.service.scene import cube_file, large_cube_file
from bench.service.serving import Served, serving
from bench.service.sheet import NONE, Sheet, reached
from bench.service.wire import Connection, request

ROOM_BYTES = 10 * 10**9
"""Free space that the large cube wants: itself, under way, stored, and at the peer."""
FLAT_MB = 64.0
"""Growth up to which memory counts as flat: eight pieces of an upload."""


def bench_upload(work: Path, options: Options) -> dict[str, Any]:
    """Send each cube up and fetch it again ``repeats`` times."""
    figures: dict[str, Any] = {"nginx": nginx_version(), "cubes": {}}
    headers = [cube_file(work)]
    if shutil.disk_usage(work).free > ROOM_BYTES:
        headers.append(large_cube_file(work))
    root = work / "put-root"
    root.mkdir()
    with serving(work / "upload") as served, nginx(root, work / "nginx-upload") as peer:
        for header in headers:
            data = header.with_suffix(".raw")
            runs = [_round(served, peer, header, data) for _ in range(options.repeats)]
            figures["cubes"][header.stem] = {
                "bytes": data.stat().st_size,
                "sha256_s": _hash_seconds(data),
                "runs": runs,
            }
            data.unlink()
            header.unlink()
    return figures


def sheet_upload(figures: dict[str, Any]) -> list[Sheet]:
    """MB/s, and memory."""
    speed = Sheet(
        "A cube up (client, tus, pieces of 8 MiB) and down (`GET …/content`), MB/s, fastest run",
        ("cube GB", "up", "nginx PUT", "SHA-256 alone", "API CPU s/GB", "down", "nginx GET", "API CPU s/GB"),
    )
    memory = Sheet(
        "Resident memory of the API's process, MB, largest of all runs",
        ("cube GB", "before", "peak up", "after", "peak down", "after", "growth", "wanted", "met"),
    )
    for cube in figures["cubes"].values():
        size, runs = cube["bytes"], cube["runs"]

        def rate(name: str, size: int = size, runs: list[dict[str, Any]] = runs) -> str:
            found = [run[name] for run in runs if name in run]
            return f"{size / 1e6 / min(found):.0f}" if found else NONE

        speed.rows.append(
            (
                f"{size / 1e9:.2f}",
                rate("up_s"),
                rate("nginx_up_s"),
                f"{size / 1e6 / cube['sha256_s']:.0f}",
                f"{min(run['up_cpu_s'] for run in runs) * 1e9 / size:.2f}",
                rate("down_s"),
                rate("nginx_down_s"),
                f"{min(run['down_cpu_s'] for run in runs) * 1e9 / size:.2f}",
            )
        )
        worst = max(runs, key=_growth)
        memory.rows.append(
            (
                f"{size / 1e9:.2f}",
                *(f"{value:.0f}" for value in worst["memory_mb"].values()),
                f"{_growth(worst):.0f}",
                f"<= {FLAT_MB:.0f}",
                reached(_growth(worst), FLAT_MB, least=False),
            )
        )
    speed.notes.append(
        "Up, the client hashes each piece and the whole file, the service each piece on arrival and the whole file at "
        "its end, flushes it to the disk and judges it, all within the time; nginx writes it and no more."
    )
    if len(figures["cubes"]) == 1:
        speed.notes.append("There was no room for the cube of 1.5 GB.")
    if figures["nginx"] is None:
        speed.notes.append(NO_NGINX)
    return [speed, memory]


def _growth(run: dict[str, Any]) -> float:
    memory = run["memory_mb"]
    return float(max(memory["peak_up"], memory["peak_down"]) - memory["before"])


def _round(served: Served, peer: Nginx | None, header: Path, data: Path) -> dict[str, Any]:
    """One cube up and down at both places."""
    memory = {"before": served.memory_mb()}
    served.forget_peak()
    with served.client() as client:
        acquisition = client.acquisitions.create("bench")
        cpu, start = served.cpu_seconds(), time.perf_counter()
        stored = client.acquisitions.upload(acquisition, cube=(header, data))[-1]
        up_s, up_cpu_s = time.perf_counter() - start, served.cpu_seconds() - cpu
        if stored.refused:
            raise RuntimeError(f"the cube was refused: {stored.reason}")
        memory |= {"peak_up": served.peak_mb(), "after_up": served.memory_mb()}
        served.forget_peak()
        path = f"/v1/acquisitions/{acquisition.id}/files/{stored.id}/content"
        cpu = served.cpu_seconds()
        down_s = _fetched(served.address, request(served.address, path, {"Authorization": served.bearer}), data)
        down_cpu_s = served.cpu_seconds() - cpu
        memory |= {"peak_down": served.peak_mb(), "after_down": served.memory_mb()}
        client.acquisitions.delete(acquisition)
    run: dict[str, Any] = {"up_s": up_s, "up_cpu_s": up_cpu_s, "down_s": down_s, "down_cpu_s": down_cpu_s}
    if peer is not None:
        os.sync()
        run["nginx_up_s"] = _put(peer, data)
        run["nginx_down_s"] = _fetched(peer.address, request(peer.address, "/put/cube.raw"), data)
        (peer.root / "put" / "cube.raw").unlink()
    os.sync()
    return {name: round(value, 3) for name, value in run.items()} | {
        "memory_mb": {name: round(value, 1) for name, value in memory.items()}
    }


def _fetched(address: tuple[str, int], sent: bytes, data: Path) -> float:
    """Seconds to fetch a file, the bytes of which are dropped."""
    connection = Connection(address)
    start = time.perf_counter()
    received = connection.exchange(sent)
    seconds = time.perf_counter() - start
    connection.close()
    if received != data.stat().st_size:
        raise RuntimeError(f"{received} bytes came, not {data.stat().st_size}")
    return seconds


def _put(peer: Nginx, data: Path) -> float:
    """Seconds to put a file at the peer."""
    connection = Connection(peer.address)
    length = {"Content-Length": str(data.stat().st_size)}
    start = time.perf_counter()
    connection.exchange(request(peer.address, "/put/cube.raw", length, "PUT"), data)
    seconds = time.perf_counter() - start
    connection.close()
    return seconds


def _hash_seconds(data: Path) -> float:
    """What hashing the file takes on this machine, once."""
    start = time.perf_counter()
    with open(data, "rb") as file:
        hashlib.file_digest(file, "sha256")
    return round(time.perf_counter() - start, 3)

"""A stored shard over HTTP, whole and in ranges; nginx serves the same file to the same client."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.service.options import Options
from bench.service.peer import NO_NGINX, nginx, nginx_version
from bench.service.scene import put_result
from bench.service.serving import serving
from bench.service.sheet import NONE, Sheet, reached
from bench.service.wire import load, request

SHARD = "spectra/c/0/0"
RANGES = {"whole": None, "1 MiB ranges": 1 << 20, "128 KiB ranges": 1 << 17}
CLIENTS = (1, 4)
SECONDS = 3.0
SHARE_TARGET = 0.5


def bench_shard(work: Path, options: Options) -> dict[str, Any]:
    """Send the shard as often as it goes in some seconds, from the service and from nginx in turn."""
    with serving(work / "shard") as served:
        result = put_result(served, work)
        size = (result.group / SHARD).stat().st_size
        with nginx(result.group, work / "nginx-shard") as peer:
            figures: dict[str, Any] = {"bytes": size, "nginx": nginx_version(), "runs": {}}
            places = {"service": (served.address, f"{result.path}/zarr/{SHARD}", {"Authorization": served.bearer})}
            if peer is not None:
                places["nginx"] = peer.address, f"/{SHARD}", {}
            for _ in range(options.repeats):
                for name, step in RANGES.items():
                    for clients in CLIENTS:
                        for place, (address, path, headers) in places.items():
                            asked = [request(address, path, headers | span) for span in _spans(size, step)]
                            cpu = served.cpu_seconds()
                            run = load(address, asked, clients, SECONDS)
                            sent = run.received
                            found = {"mb_per_s": round(sent / run.seconds / 1e6, 1), **run.as_dict()}
                            if place == "service":
                                found["cpu_s_per_gb"] = round((served.cpu_seconds() - cpu) / sent * 1e9, 3)
                            key = f"{name}, {clients} client{'s' if clients > 1 else ''}"
                            figures["runs"].setdefault(key, {}).setdefault(place, []).append(found)
    return figures


def sheet_shard(figures: dict[str, Any]) -> list[Sheet]:
    """MB/s, and nginx's."""
    sheet = Sheet(
        f"A shard of {figures['bytes'] / 1e6:.0f} MB over HTTP, fastest run",
        ("request", "MB/s", "nginx MB/s", "of nginx's", "wanted", "met", "p50 ms", "API CPU s/GB"),
    )
    for name, places in figures["runs"].items():
        best = max(places["service"], key=lambda run: run["mb_per_s"])
        row = [name, f"{best['mb_per_s']:.0f}"]
        if "nginx" in places:
            other = max(run["mb_per_s"] for run in places["nginx"])
            share = best["mb_per_s"] / other
            row += [
                f"{other:.0f}",
                f"{100 * share:.0f} %",
                f">= {100 * SHARE_TARGET:.0f} %",
                reached(share, SHARE_TARGET, least=True),
            ]
        else:
            row += [NONE] * 4
        sheet.rows.append((*row, f"{best['p50_ms']:.2f}", f"{best['cpu_s_per_gb']:.2f}"))
    sheet.notes.append("From the page cache over loopback; the client shares the cores.")
    if figures["nginx"] is None:
        sheet.notes.append(NO_NGINX)
    return [sheet]


def _spans(size: int, step: int | None) -> list[dict[str, str]]:
    """Headers of requests that together read the file."""
    if step is None:
        return [{}]
    return [{"Range": f"bytes={start}-{min(start + step, size) - 1}"} for start in range(0, size, step)]

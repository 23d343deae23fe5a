"""A whole cloud read by the libraries that people read Zarr with: from the disk, from nginx, from the service."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore
import zarr
from numpy.typing import NDArray
from obstore.store import HTTPStore
from zarr.storage import ObjectStore

from bench.service.options import Options
from bench.service.peer import NO_NGINX, nginx, nginx_version
from bench.service.scene import Result, folder_bytes, put_result
from bench.service.serving import Served, serving
from bench.service.sheet import NONE, Sheet
from specimap_core.cloud.schema import ARRAYS

Arrays = dict[str, NDArray[Any]]
Reader = Callable[[], Arrays]
ROWS = {
    "zarr": "zarr-python",
    "tensorstore": "tensorstore",
    "client": "client, `cloud.zarr()`",
    "specimap": "Specimap's own reader",
    "download": "client, `cloud.download()` to disk",
}
PLACES = ("disk", "nginx", "service")


def bench_cloud(work: Path, options: Options) -> dict[str, Any]:
    """Read all arrays ``repeats`` times with each library from each place; what was read is compared each time."""
    with serving(work / "cloud") as served:
        result = put_result(served, work)
        truth = _by_specimap(result)()
        figures: dict[str, Any] = {
            "points": result.cloud.n_points,
            "bands": result.cloud.bands,
            "decoded_bytes": sum(values.nbytes for values in truth.values()),
            "stored_bytes": folder_bytes(result.group),
            "nginx": nginx_version(),
            "runs": {},
        }
        with _readers(served, result, work) as readers:
            # In turn, so that whatever else the machine does meets all of them.
            for (row, place), read in list(readers.items()) * options.repeats:
                cpu, start = served.cpu_seconds(), time.perf_counter()
                found = read()
                run = {"seconds": round(time.perf_counter() - start, 4)}
                if place == "service":
                    run["cpu_s"] = round(served.cpu_seconds() - cpu, 3)
                figures["runs"].setdefault(row, {}).setdefault(place, []).append(run)
                if any(not np.array_equal(values, truth[name]) for name, values in found.items()):
                    raise RuntimeError(f"{row} read other values from {place}")
        figures["runs"]["download"] = {"service": _downloads(served, result, work, options.repeats)}
    return figures


def sheet_cloud(figures: dict[str, Any]) -> list[Sheet]:
    """MB/s of decoded values."""
    megabytes = figures["decoded_bytes"] / 1e6
    sheet = Sheet(
        f"A whole cloud ({figures['points']} points x {figures['bands']} bands: {megabytes:.0f} MB, "
        f"{figures['stored_bytes'] / 1e6:.0f} MB as stored), MB/s of values, fastest run",
        ("read by", "disk", "nginx", "service", "of the disk's", "API CPU s"),
    )
    for row, places in figures["runs"].items():
        speed = {place: megabytes / min(run["seconds"] for run in runs) for place, runs in places.items()}
        share = f"{100 * speed['service'] / speed['disk']:.0f} %" if {"service", "disk"} <= speed.keys() else NONE
        cpu = f"{min(run['cpu_s'] for run in places['service']):.2f}" if "service" in places else NONE
        sheet.rows.append((ROWS[row], *(f"{speed[p]:.0f}" if p in speed else NONE for p in PLACES), share, cpu))
    sheet.notes.append("The files lie in the page cache; reader and server share the cores.")
    if figures["nginx"] is None:
        sheet.notes.append(NO_NGINX)
    return [sheet]


@contextmanager
def _readers(served: Served, result: Result, work: Path) -> Iterator[dict[tuple[str, str], Reader]]:
    address, headers = f"{served.url}{result.path}/zarr", {"Authorization": served.bearer}
    with nginx(result.group, work / "nginx-cloud") as peer, served.client() as client:
        readers = {
            ("zarr", "disk"): _by_zarr(lambda: str(result.group)),
            ("tensorstore", "disk"): _by_tensorstore({"driver": "file", "path": str(result.group)}),
            ("specimap", "disk"): _by_specimap(result),
            ("zarr", "service"): _by_zarr(lambda: _http_store(address, headers)),
            ("tensorstore", "service"): _by_tensorstore(_http_spec(address, headers)),
            ("client", "service"): lambda: _all_of(client.clouds.get(result.cloud_id).zarr()),
        }
        if peer is not None:
            other = f"http://{peer.address[0]}:{peer.address[1]}"
            readers[("zarr", "nginx")] = _by_zarr(lambda: _http_store(other, {}))
            readers[("tensorstore", "nginx")] = _by_tensorstore(_http_spec(other, {}))
        yield readers


def _downloads(served: Served, result: Result, work: Path, repeats: int) -> list[dict[str, float]]:
    runs = []
    with served.client() as client:
        cloud, target = client.clouds.get(result.cloud_id), work / "downloaded.zarr"
        for _ in range(repeats):
            cpu, start = served.cpu_seconds(), time.perf_counter()
            cloud.download(target)
            seconds = time.perf_counter() - start
            runs.append({"seconds": round(seconds, 4), "cpu_s": round(served.cpu_seconds() - cpu, 3)})
            if not np.array_equal(zarr.open_array(target / "xyz", mode="r")[...], result.cloud.xyz):
                raise RuntimeError("the download has other points")
            shutil.rmtree(target)
    return runs


# ---- the libraries ------------------------------------------------------------------------------------


def _all_of(group: zarr.Group) -> Arrays:
    return {name: np.asarray(group[name][...]) for name in ARRAYS}  # type: ignore[index]


def _by_zarr(store: Callable[[], Any]) -> Reader:
    return lambda: _all_of(zarr.open_group(store(), mode="r", zarr_format=3))


def _http_store(address: str, headers: Mapping[str, str]) -> ObjectStore[HTTPStore]:
    options: Any = {"allow_http": True, "default_headers": dict(headers)}
    return ObjectStore(HTTPStore.from_url(address, client_options=options), read_only=True)


def _http_spec(address: str, headers: Mapping[str, str]) -> dict[str, Any]:
    return {"driver": "http", "base_url": address, "headers": [f"{name}: {value}" for name, value in headers.items()]}


def _by_tensorstore(store: Mapping[str, Any]) -> Reader:
    where = "base_url" if "base_url" in store else "path"

    def read() -> Arrays:
        kept = {name: {**store, where: f"{store[where]}/{name}/"} for name in ARRAYS}
        opened = [tensorstore.open({"driver": "zarr3", "kvstore": kvstore}) for kvstore in kept.values()]
        asked = [array.result().read() for array in opened]
        return dict(zip(ARRAYS, (values.result() for values in asked), strict=True))

    return read


def _by_specimap(result: Result) -> Reader:
    def read() -> Arrays:
        cloud = result.cloud
        rest = {name: cloud.array(name).read(0, cloud.array(name).shape[0]) for name in ARRAYS if name != "spectra"}
        return {"spectra": cloud.stored_spectra(slice(None)), **rest}

    return read

"""A client that asks for as much as it can, in a process of its own."""

from __future__ import annotations

import io
import os
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from multiprocessing.connection import Connection

import httpx
import numpy as np
from PIL import Image

RETRY_SECONDS = 0.5
"""It does not wait as long as it is told to: 48 clients then ask as often as the usual rate of a key lets them."""
Ask = Callable[[httpx.Client], httpx.Response]


@dataclass(frozen=True)
class Kind:
    """``words``: for people; ``clients``: how many ask at a time; ``make(cloud_id)`` gives what each asks."""

    words: str
    clients: int
    make: Callable[[str], Callable[[], Ask]]


def run_hostile(name: str, url: str, key: str, cloud_id: str, parent: Connection) -> None:
    """Ask until the parent sends something; then tell it how many answers of each status came."""
    kind, stop = KINDS[name], threading.Event()
    make, answers, lock = kind.make(cloud_id), Counter[str](), threading.Lock()

    def ask_on() -> None:
        ask = make()
        headers = {"Authorization": f"Bearer {key}"}
        with httpx.Client(base_url=url, headers=headers, timeout=300, trust_env=False) as client:
            while not stop.is_set():
                try:
                    status = str(ask(client).status_code)
                except httpx.HTTPError as error:
                    status = type(error).__name__
                with lock:
                    answers[status] += 1
                if status in ("429", "503"):
                    stop.wait(RETRY_SECONDS)

    threads = [threading.Thread(target=ask_on, daemon=True) for _ in range(kind.clients)]
    for thread in threads:
        thread.start()
    parent.send("ready")
    parent.recv()
    stop.set()
    with lock:
        parent.send(dict(answers))


# ---- what is asked ------------------------------------------------------------------------------------


def _photos(side: int) -> Callable[[str], Callable[[], Ask]]:
    """PNG files of 16 bits a pixel and hardly any bytes."""

    def make(cloud_id: str) -> Callable[[], Ask]:
        pixels = np.zeros((side, side), np.uint16)
        pixels[::7, ::5] = 40_000
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG")

        def of_client() -> Ask:
            places: list[str] = []

            def ask(client: httpx.Client) -> httpx.Response:
                if not places:
                    answer = client.post("/v1/acquisitions", json={"specimen_id": "hostile"}).raise_for_status()
                    places.append(f"/v1/acquisitions/{answer.json()['id']}/files")
                # Each is another file, or it would be refused as the same one.
                content = file.getvalue() + os.urandom(16)
                answer = client.post(places[0], data={"role": "photo"}, files={"file": ("x.png", content)})
                if answer.status_code == 413:
                    places.clear()
                return answer

            return ask

        return of_client

    return make


def _pictures(cloud_id: str) -> Callable[[], Ask]:
    numbers = count()
    path = f"/v1/clouds/{cloud_id}/previews/index.png"

    def ask(client: httpx.Client) -> httpx.Response:
        number = next(numbers)
        bands = {"a": str(number % 280), "b": str(281 + number % 7)}
        return client.get(path, params={**bands, "size": 1024 + number % 1000, "grid": "marker"})

    return lambda: ask


def _spectra(points: int, accept: str) -> Callable[[str], Callable[[], Ask]]:
    def make(cloud_id: str) -> Callable[[], Ask]:
        indices = np.random.default_rng(0).integers(0, 290_000, points).tolist()
        body = {"select": {"indices": indices}, "limit": points}

        def ask(client: httpx.Client) -> httpx.Response:
            return client.post(f"/v1/clouds/{cloud_id}/spectra", json=body, headers={"Accept": accept})

        return lambda: ask

    return make


KINDS = {
    "files": Kind("7 uploads of PNG, 9000 x 9000 x 16 bit", 7, _photos(9000)),
    "allowed": Kind("the same, as large as is judged (7700 x 7700)", 7, _photos(7700)),
    "many": Kind("64 uploads of these at a time", 64, _photos(7700)),
    "pictures": Kind("48 previews at a time", 48, _pictures),
    "spectra": Kind("16 pages of 100,000 spectra at a time, NumPy", 16, _spectra(100_000, "application/x-npy")),
    "json": Kind("16 pages of 10,000 spectra at a time, JSON", 16, _spectra(10_000, "application/json")),
}
"""By name."""

"""One key that asks for much, and another beside it, whose requests are answered meanwhile."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
import uvicorn

from specimap_core.threads import NICENESS
from specimap_infra.settings import load_settings
from specimap_service.acquisitions.dependencies import INTAKE
from specimap_service.acquisitions.judge import CHILDREN, Judge
from specimap_service.app import create_app
from specimap_service.clouds import picture_queue
from specimap_service.clouds.dependencies import PICTURES
from specimap_service.clouds.picture_queue import DRAWN
from specimap_service.fair_turns import FairTurns, TurnBounds
from tests.support import held_drawing
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import OCTETS, TUS, created, new_acquisition, photos, process_serving, send, sent
from tests.support.worker_scene import until

BEHIND = min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)
"""Rank of what gives way to the processes that answer."""

# Photos that begin so are judged when a file is gone; all others as always.
HELD = """
import sys, time
from pathlib import Path
from specimap_core.screening import process as child
real = child.TASKS["photo"]

def held(task):
    if open(task["path"], "rb").read(4) == b"HOLD":
        Path("{started}").joinpath(str(time.monotonic_ns())).touch()
        while Path("{hold}").exists():
            time.sleep(0.02)
    return real(task)

child.TASKS["photo"] = held
child.main()
"""


@contextmanager
def asking(ask: Callable[[int], httpx.Response], number: int) -> Iterator[list[Future[httpx.Response]]]:
    """Requests under way at the same time, each in a thread of its own."""
    with ThreadPoolExecutor(number) as pool:
        yield [pool.submit(ask, k) for k in range(number)]


@pytest.fixture
def beside(tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", own_judge=True, sandbox="off") as running:
        yield running


# ---- files --------------------------------------------------------------------------------------------


def test_a_photo_is_judged_before_another_keys_backlog(beside: Running, tmp_path: Path) -> None:
    hold, started = tmp_path / "hold", tmp_path / "started"
    hold.touch()
    started.mkdir()
    judge: Judge = beside.app.state.judge
    judge._command = (sys.executable, "-c", HELD.format(hold=hold, started=started), *judge._command[3:])
    hostile, other = beside.client(), beside.client()
    theirs, ours = new_acquisition(hostile), new_acquisition(other)

    def upload(number: int) -> httpx.Response:
        data = b"HOLD%d" % number
        if number % 2:
            return send(hostile, theirs, "photo", "x.png", data)
        place = created(hostile, theirs, "photo", len(data))
        headers = {**TUS, "Upload-Offset": "0", "Content-Type": OCTETS}
        return hostile.patch(place, content=data, headers=headers)

    with asking(upload, 24) as uploads:
        try:
            waiting = INTAKE.of(beside.app)
            until(lambda: waiting.waiting >= 20, 20, "the backlog")
            until(lambda: len(list(started.iterdir())) == CHILDREN.of_key, 20, "two held children")
            for number in range(3):
                file = sent(other, ours, "photo", f"{number}.jpg", photos()[number].read_bytes())
                assert file["state"] == "accepted"
            assert other.get("/v1/jobs").status_code == 200
            assert hostile.get("/v1/jobs").status_code == 200
            # Nothing of the backlog has moved.
            assert not any(upload.done() for upload in uploads)
            assert len(list(started.iterdir())) == CHILDREN.of_key
            pids = [child.pid for child in judge._children]
            assert {os.getpriority(os.PRIO_PROCESS, pid) for pid in pids} == {BEHIND}
        finally:
            hold.unlink()
        assert {upload.result().status_code for upload in uploads} == {201, 204}
    files = hostile.get(f"/v1/acquisitions/{theirs}/files").json()
    assert {file["judgement"]["code"] for file in files} == {"photo_unreadable"}
    assert len(files) == 24


def test_more_files_than_may_wait_are_refused_and_kept(beside: Running, tmp_path: Path) -> None:
    hold, started = tmp_path / "hold", tmp_path / "started"
    hold.touch()
    started.mkdir()
    judge: Judge = beside.app.state.judge
    judge._command = (sys.executable, "-c", HELD.format(hold=hold, started=started), *judge._command[3:])
    # Uploads have the same object.
    INTAKE.of(beside.app).bounds = TurnBounds(at_once=1, of_key=1, waiting=2, waiting_of_key=1, retry_after_s=3)
    client = beside.client()
    acquisition = new_acquisition(client)
    place = created(client, acquisition, "photo", 4)
    headers = {**TUS, "Upload-Offset": "0", "Content-Type": OCTETS}
    with asking(lambda k: send(client, acquisition, "photo", "x.png", b"HOLD%d" % k), 2) as uploads:
        try:
            until(lambda: INTAKE.of(beside.app).waiting == 1, 20, "one that waits")
            for refused in (
                send(client, acquisition, "photo", "x.png", b"HOLD!"),
                client.patch(place, content=b"HOLD", headers=headers),
                client.head(place, headers=TUS),
                client.get(f"{place}/result"),
            ):
                assert (refused.status_code, refused.headers["retry-after"]) == (429, "3")
                assert refused.request.method == "HEAD" or refused.json()["code"] == "too_many_at_once"
            stranger = beside.client()
            theirs = new_acquisition(stranger)
            with asking(lambda k: send(stranger, theirs, "photo", "x.png", b"HOLD%d" % k), 1) as more:
                until(lambda: INTAKE.of(beside.app).waiting == 2, 20, "another key's")
                third = beside.client()
                full = send(third, new_acquisition(third), "photo", "x.png", b"HOLD")
                assert (full.status_code, full.headers["retry-after"]) == (503, "3")
                assert full.json()["code"] == "overloaded"
                hold.unlink()
                assert more[0].result().status_code == 201
        finally:
            hold.unlink(missing_ok=True)
        assert {upload.result().status_code for upload in uploads} == {201}
    # The bytes of the refused upload were kept: the next question finishes it.
    assert client.get(f"{place}/result").json()["state"] == "finished"


def test_a_file_whose_client_went_away_while_it_waited_is_not_judged(beside: Running, tmp_path: Path) -> None:
    hold, started = tmp_path / "hold", tmp_path / "started"
    hold.touch()
    started.mkdir()
    judge: Judge = beside.app.state.judge
    judge._command = (sys.executable, "-c", HELD.format(hold=hold, started=started), *judge._command[3:])
    intake = INTAKE.of(beside.app)
    intake.bounds = TurnBounds(at_once=1, of_key=1, waiting=9, waiting_of_key=9)
    client = beside.client()
    acquisition = new_acquisition(client)
    place = created(client, acquisition, "photo", 4)
    headers = {**TUS, "Upload-Offset": "0", "Content-Type": OCTETS}
    impatient = httpx.Timeout(60, read=0.5)
    with asking(lambda k: send(client, acquisition, "photo", "x.png", b"HOLD"), 1) as uploads:
        try:
            until(lambda: len(list(started.iterdir())) == 1, 20, "the file that is judged")
            asks: list[Callable[[], httpx.Response]] = [
                lambda: client.patch(place, content=b"HOLD", headers=headers, timeout=impatient),
                lambda: client.get(f"{place}/result", timeout=impatient),
                lambda: client.head(place, headers=TUS, timeout=impatient),
                lambda: client.post(
                    f"/v1/acquisitions/{acquisition}/files",
                    data={"role": "photo"},
                    files={"file": ("y.png", b"HOLD")},
                    timeout=impatient,
                ),
            ]
            for ask in asks:
                with pytest.raises(httpx.ReadTimeout):
                    ask()
                until(lambda: intake.waiting == 0, 10, "the end of the wait")
        finally:
            hold.unlink()
        assert uploads[0].result().status_code == 201
    assert len(list(started.iterdir())) == 1
    assert len(client.get(f"/v1/acquisitions/{acquisition}/files").json()) == 1
    # The bytes that arrived were kept.
    assert client.get(f"{place}/result").json()["state"] == "finished"


# ---- pictures -----------------------------------------------------------------------------------------


@pytest.fixture
def held(beside: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Running, Result]]:
    """A service with a cloud, the pictures of which are not drawn until the file ``hold`` is gone."""
    monkeypatch.setattr(picture_queue, "draw", held_drawing.draw)
    hold = beside.settings.data_dir / "hold"
    hold.touch()
    yield beside, put_result(beside, tmp_path / "result")
    hold.unlink(missing_ok=True)


def previews(client: httpx.Client, result: Result, size: int) -> httpx.Response:
    return client.get(f"/v1/clouds/{result.cloud_id}/previews/rgb.png", params={"size": size})


@pytest.mark.slow
def test_pictures_of_one_key_hold_up_no_answer_to_another(held: tuple[Running, Result]) -> None:
    service, result = held
    hostile, other = service.client(["read"]), service.client(["read"])
    threads = threading.active_count()
    # More than the threads that answer requests.
    with asking(lambda k: previews(hostile, result, 100 + k), 48) as asked:
        try:
            turns: FairTurns = PICTURES.of(service.app)._turns
            until(lambda: turns.waiting == DRAWN.waiting_of_key, 20, "the backlog")
            refused = [
                f.result() for f in until(lambda: _many(asked, 48 - DRAWN.of_key - turns.waiting), 20, "refusals")
            ]
            for answer in refused:
                assert (answer.status_code, answer.json()["code"]) == (429, "too_many_at_once")
                assert int(answer.headers["retry-after"]) >= 1
            assert other.get("/v1/jobs").status_code == 200
            assert other.get(f"/v1/clouds/{result.cloud_id}/points/0").status_code == 200
            drawn = previews(other, result, 999)
            assert (drawn.status_code, drawn.headers["content-type"]) == (200, "image/png")
            # Waiting takes no threads: those there are 48 clients, and fewer of the service's than wait.
            assert threading.active_count() - threads - 48 < DRAWN.waiting_of_key
            assert turns.waiting == DRAWN.waiting_of_key
        finally:
            (service.settings.data_dir / "hold").unlink()
        codes = [answer.result().status_code for answer in asked]
    assert (codes.count(200), codes.count(429)) == (DRAWN.of_key + DRAWN.waiting_of_key, len(refused))


def _many(asked: list[Future[httpx.Response]], number: int) -> list[Future[httpx.Response]] | None:
    done = [future for future in asked if future.done()]
    return done if len(done) == number else None


@pytest.mark.slow
def test_where_all_keys_wait_for_pictures_the_service_says_so(held: tuple[Running, Result]) -> None:
    service, result = held
    queue = PICTURES.of(service.app)
    queue._turns = FairTurns(TurnBounds(at_once=1, of_key=1, waiting=1, waiting_of_key=5, retry_after_s=2))
    first, second = service.client(["read"]), service.client(["read"])
    with asking(lambda k: previews(first, result, 100 + k), 2) as asked:
        try:
            until(lambda: queue._turns.waiting == 1, 20, "one that waits")
            full = previews(second, result, 200)
            assert (full.status_code, full.json()["code"], full.headers["retry-after"]) == (503, "overloaded", "2")
        finally:
            (service.settings.data_dir / "hold").unlink()
        assert [answer.result().status_code for answer in asked] == [200, 200]


@pytest.mark.slow
def test_a_drawing_process_that_dies_costs_one_picture(tmp_path: Path) -> None:
    # A process of its own, which hears of the ends of its children as the real service does.
    with process_serving(tmp_path) as (process, url):
        settings = load_settings(data_dir=tmp_path)
        app = create_app(settings)
        # Only its settings and database: the process serves.
        service = Running(url, settings, app, uvicorn.Server(uvicorn.Config(app)))
        result, client = put_result(service, tmp_path / "result"), service.client(["read"])
        assert previews(client, result, 100).status_code == 200
        (pid,) = _drawing_processes(process.pid)
        assert os.getpriority(os.PRIO_PROCESS, pid) == BEHIND
        # Stopped, so that it cannot have drawn the picture before it is killed.
        os.kill(pid, signal.SIGSTOP)
        with asking(lambda k: previews(client, result, 200 + k), 1) as asked:
            time.sleep(0.3)
            os.kill(pid, signal.SIGKILL)
            answer = asked[0].result()
        assert (answer.status_code, answer.json()["code"]) == (503, "backend_unavailable")
        assert previews(client, result, 200).status_code == 200
        client.close()


def _drawing_processes(parent: int) -> list[int]:
    pids = [pid for task in Path(f"/proc/{parent}/task").iterdir() for pid in (task / "children").read_text().split()]
    return [int(pid) for pid in pids if b"anyio.to_process" in Path(f"/proc/{pid}/cmdline").read_bytes()]

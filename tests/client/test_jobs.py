"""Jobs followed by their events, over breaks, and by asking where the stream is held back."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

import specimap_client as sc
from specimap_client import _events
from tests.support.client_scene import client_of, problem, sse
from tests.support.job_answers import JOB

QUEUED = (1, "state", {"state": "queued", "starts": 0})
RUNNING = (2, "state", {"state": "running", "starts": 1})
HALF = (3, "progress", {"stage": "render", "progress": 0.5})
LINE = (4, "log", {"level": "info", "message": "zwei\u2028Zeilen", "data": {}})
DONE = (5, "state", {"state": "succeeded", "error": None, "cloud_id": "cloud_1"})
STREAM = {"Content-Type": "text/event-stream; charset=utf-8"}


class Breaking(httpx.SyncByteStream):
    """A stream that ends with an error."""

    def __init__(self, pieces: Iterator[bytes], error: Exception | None) -> None:
        self._pieces, self._error = pieces, error

    def __iter__(self) -> Iterator[bytes]:
        yield from self._pieces
        if self._error is not None:
            raise self._error


class JobService:
    """Answers for one job: streams in turn, and states in turn, the last of them for ever."""

    def __init__(self, states: list[dict[str, Any]], *streams: Callable[[], httpx.Response]) -> None:
        self.states, self.streams = states, list(streams)
        self.resumed: list[str | None] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        if request.url.path.endswith("/events"):
            self.resumed.append(request.headers.get("Last-Event-ID"))
            return self.streams.pop(0)() if self.streams else problem(404, "not_found")
        state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
        return httpx.Response(200, json=JOB | state)


def stream(*events: tuple[int, str, dict[str, Any]], error: Exception | None = None) -> Callable[[], httpx.Response]:
    return lambda: httpx.Response(200, headers=STREAM, stream=Breaking(sse(*events), error))


SUCCEEDED: dict[str, Any] = {"state": "succeeded", "progress": 1.0, "cloud_id": "cloud_1"}


def test_wait_follows_the_stream(waits: list[float]) -> None:
    service = JobService([{}, SUCCEEDED], stream(QUEUED, RUNNING, HALF, LINE, DONE))
    heard: list[sc.Job] = []
    with client_of(service) as client:
        job = client.jobs.wait("job_1", progress=heard.append)
    assert (job.state, job.cloud_id) == ("succeeded", "cloud_1")
    assert [(j.state, j.stage, j.progress) for j in heard] == [
        ("queued", None, 0.0),
        ("running", None, 0.0),
        ("running", "render", 0.5),
        ("succeeded", "render", 0.5),
        ("succeeded", None, 1.0),
    ]
    assert waits == []


@pytest.mark.parametrize(
    "error", [None, httpx.ReadError("reset"), httpx.RemoteProtocolError("incomplete chunked read")]
)
def test_events_resume_after_the_last_one(waits: list[float], error: Exception | None) -> None:
    streams = [
        stream(QUEUED, RUNNING, error=error),
        stream(HALF, error=error),
        lambda: problem(503, "x"),
        stream(LINE, DONE),
    ]
    service = JobService([SUCCEEDED], *streams)
    with client_of(service) as client:
        events = list(client.jobs.events("job_1"))
    assert [event.seq for event in events] == [1, 2, 3, 4, 5]
    assert events[3].data["message"] == "zwei\u2028Zeilen"
    assert service.resumed == [None, "2", "3", "3"]
    assert len(waits) == 3


def test_events_of_an_ended_job_that_are_all_known_end(waits: list[float]) -> None:
    service = JobService([SUCCEEDED], lambda: httpx.Response(204))
    with client_of(service) as client:
        assert list(client.jobs.events("job_1", after=5)) == []
    assert service.resumed == ["5"]


def test_events_give_up_when_nothing_new_comes(waits: list[float]) -> None:
    service = JobService([{}], stream(QUEUED), *[stream()] * 9)
    with client_of(service) as client, pytest.raises(sc.ConnectionFailed):
        list(client.jobs.events("job_1"))
    assert len(service.resumed) == 1 + 3


def test_stream_that_is_held_back_is_replaced_by_asking(waits: list[float]) -> None:
    silent = stream(error=httpx.ReadTimeout("nothing came"))
    states: list[dict[str, Any]] = [
        {},
        {"state": "running", "stage": "adjust", "progress": 0.25},
        {"state": "running", "stage": "adjust"},
        SUCCEEDED,
    ]
    service = JobService(states, silent, silent, silent)
    heard: list[sc.Job] = []
    with client_of(service) as client:
        assert client.jobs.wait("job_1", progress=heard.append).state == "succeeded"
    assert len(service.resumed) == 2
    assert [(j.state, j.progress) for j in heard] == [
        ("queued", 0.0),
        ("running", 0.25),
        ("running", 0.0),
        ("succeeded", 1.0),
    ]


def test_page_instead_of_a_stream_is_replaced_by_asking(waits: list[float]) -> None:
    service = JobService([{}, SUCCEEDED], lambda: httpx.Response(200, text="<html>"))
    with client_of(service) as client:
        assert client.jobs.wait("job_1").state == "succeeded"


def test_failed_and_cancelled_jobs_raise_with_their_reason(waits: list[float]) -> None:
    error = {"code": "too_few_photos", "message": "Only 3 photos.", "advice": "Take more.", "details": {"n": 3}}
    with client_of(JobService([{"state": "failed", "error": error}])) as client:
        with pytest.raises(sc.JobFailed, match=r"Only 3 photos\. Take more\.") as caught:
            client.jobs.wait("job_1")
        assert caught.value.code == "too_few_photos"
        assert caught.value.job.error is not None
        assert caught.value.job.error.details == {"n": 3}
    with client_of(JobService([{"state": "cancelled"}])) as client, pytest.raises(sc.JobFailed) as caught:
        client.jobs.wait("job_1")
    assert caught.value.code == "cancelled"


def test_wait_has_a_limit(waits: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def later() -> float:
        nonlocal now
        now += 1.0
        return now

    monkeypatch.setattr(time, "monotonic", later)
    service = JobService([{}], *[stream(QUEUED, error=httpx.ReadTimeout("slow"))] * 99)
    with client_of(service) as client, pytest.raises(sc.Timeout):
        client.jobs.wait("job_1", timeout=10)
    assert now < 30


def test_rerun_and_cancel_and_log(waits: list[float]) -> None:
    seen: list[httpx.Request] = []

    def handler(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        if request.url.path.endswith("/log"):
            line = {"seq": 4, "at": "2026-11-22T06:00:00Z", "level": "info", "message": "m", "data": {"a": 1}}
            return httpx.Response(200, json={"items": [line], "next": None})
        return httpx.Response(202, json=JOB)

    with client_of(handler) as client:
        job = client.jobs.get("job_1")
        client.jobs.rerun(job, priority="intraoperative", r_pc=0.25)
        client.jobs.cancel(job)
        (line,) = client.jobs.log(job)
    assert [request.url.path.rpartition("job_1")[2] for request in seen] == ["", "/rerun", "/cancel", "/log"]
    assert json.loads(seen[1].content) == {"priority": "intraoperative", "settings": {"r_pc": 0.25}}
    assert seen[1].headers["Idempotency-Key"]
    assert (line.message, line.data) == ("m", {"a": 1})


@pytest.mark.parametrize("cut", [1, 2, 3, 7, 1000])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_stream_is_read_wherever_it_is_cut(cut: int, end: str) -> None:
    text = end.join(
        [
            "retry: 3000",
            "",
            ": comment",
            "event: log",
            'data: {"a":',
            'data: "é"}',
            "id: 7",
            "",
            "data: {}",
            "",
            "id:8",
            "event:state",
            'data:{"state":"running"}',
            "",
            "id: 9",
            "data: {}",
        ]
    )
    content = text.encode()
    events = list(_events.parse(content[i : i + cut] for i in range(0, len(content), cut)))
    # The second has no id, the last is not ended: neither is an event.
    assert [(e.seq, e.type, e.data) for e in events] == [(7, "log", {"a": "é"}), (8, "state", {"state": "running"})]

"""The client's requests: retries where safe, errors with types, and a key that shows nowhere."""

from __future__ import annotations

import ssl
import traceback
from collections.abc import Callable

import httpx
import pytest

import specimap_client as sc
from specimap_client import Retries
from tests.support.client_scene import KEY, answers, client_of, problem
from tests.support.job_answers import JOB

REFUSED = httpx.ConnectError("connection refused")
BROKEN = httpx.ReadError("connection reset")


def job_answer() -> httpx.Response:
    return httpx.Response(200, json=JOB)


@pytest.mark.parametrize("fault", [REFUSED, BROKEN, httpx.ReadTimeout("slow"), problem(503, "x"), problem(502, "x")])
def test_reading_is_repeated_with_growing_waits(waits: list[float], fault: httpx.Response | Exception) -> None:
    handler, seen = answers(fault, fault, job_answer())
    with client_of(handler) as client:
        assert client.jobs.get("job_1").id == "job_1"
    assert len(seen) == 3
    assert 0.25 <= waits[0] <= 0.5 <= waits[1] <= 1.0
    assert len({request.headers["X-Correlation-Id"] for request in seen}) == 1


@pytest.mark.parametrize(
    ("fault", "leaf"),
    [(REFUSED, sc.ConnectionFailed), (httpx.ReadTimeout("slow"), sc.Timeout), (problem(503, "x"), sc.ServerError)],
)
def test_retries_end(waits: list[float], fault: httpx.Response | Exception, leaf: type[Exception]) -> None:
    handler, seen = answers(*[fault] * 9)
    with client_of(handler) as client, pytest.raises(leaf):
        client.jobs.get("job_1")
    assert (len(seen), len(waits)) == (4, 3)


def test_what_may_have_been_done_is_not_repeated(waits: list[float]) -> None:
    for fault in (BROKEN, problem(503, "x"), problem(500, "x")):
        handler, seen = answers(fault)
        with client_of(handler) as client, pytest.raises(sc.SpecimapClientError):
            client.jobs._session.json("POST", "v1/unnamed", json={})
        assert len(seen) == 1
    assert waits == []


def test_what_was_not_taken_is_repeated_even_if_it_makes_something(waits: list[float]) -> None:
    limited = problem(429, "rate_limited", {"Retry-After": "7"}, retry_after_s=7)
    handler, seen = answers(REFUSED, limited, problem(422, "request_invalid"))
    with client_of(handler) as client, pytest.raises(sc.Refused):
        client.jobs._session.json("POST", "v1/unnamed", json={})
    assert len(seen) == 3
    assert 7.0 <= waits[1] <= 9.0


def test_job_is_submitted_again_under_the_same_idempotency_key(waits: list[float]) -> None:
    handler, seen = answers(BROKEN, problem(504, "x"), job_answer(), job_answer())
    with client_of(handler) as client:
        client.jobs.submit("acq_1", r_pc=0.5)
        client.jobs.submit("acq_1", r_pc=0.5)
    keys = [request.headers["Idempotency-Key"] for request in seen]
    assert len(set(keys[:3])) == 1
    assert keys[3] != keys[0]


def test_what_creates_is_repeated_under_one_idempotency_key(waits: list[float]) -> None:
    creations: tuple[Callable[[sc.Client], object], ...] = (
        lambda client: client.acquisitions.create("S26-1"),
        lambda client: client.keys.create("tablet", ["read"]),
        lambda client: client.projects.create("study-7"),
    )
    for create in creations:
        handler, seen = answers(BROKEN, problem(503, "x"), problem(422, "request_invalid"))
        with client_of(handler) as client, pytest.raises(sc.Refused):
            create(client)
        assert len(seen) == 3
        assert len({request.headers["Idempotency-Key"] for request in seen}) == 1


def test_deletion_whose_answer_was_lost_has_succeeded(waits: list[float]) -> None:
    handler, _ = answers(BROKEN, problem(404, "not_found"))
    with client_of(handler) as client:
        client.jobs.delete("job_1")
    handler, _ = answers(REFUSED, problem(404, "not_found"))
    with client_of(handler) as client, pytest.raises(sc.NotFound):
        client.jobs.delete("job_1")


def test_a_service_that_says_much_too_long_is_not_waited_for(waits: list[float]) -> None:
    handler, _ = answers(problem(429, "rate_limited", {"Retry-After": "86400"}))
    with client_of(handler) as client, pytest.raises(sc.RateLimited) as caught:
        client.jobs.get("job_1")
    assert caught.value.retry_after == 86400
    assert waits == []


def test_certificate_that_is_not_trusted_is_told_at_once(waits: list[float]) -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("verify failed") from ssl.SSLCertVerificationError("self-signed certificate")

    with client_of(handler) as client, pytest.raises(sc.ConnectionFailed, match="verify failed"):
        client.jobs.get("job_1")
    assert waits == []


@pytest.mark.parametrize(
    ("status", "leaf"),
    [
        (401, sc.Unauthorized),
        (403, sc.Forbidden),
        (404, sc.NotFound),
        (409, sc.Conflict),
        (412, sc.Conflict),
        (413, sc.Refused),
        (422, sc.Refused),
        (500, sc.ServerError),
        (507, sc.ServerError),
    ],
)
def test_errors_have_types_and_carry_what_was_said(waits: list[float], status: int, leaf: type[sc.ApiError]) -> None:
    handler, seen = answers(problem(status, "some_code", scope="label"))
    with client_of(handler) as client, pytest.raises(sc.ApiError) as caught:
        client.jobs.get("job_1")
    error = caught.value
    assert type(error) is leaf
    assert (error.code, error.message, error.advice) == ("some_code", "It is so.", "Do otherwise.")
    assert (error.details, error.status, error.correlation_id) == ({"scope": "label"}, status, "c0ffee00")
    assert "It is so. Do otherwise." in str(error)
    assert "c0ffee00" in str(error)
    assert len(seen) == 1


def test_proxies_errors_and_pages_are_told_apart(waits: list[float]) -> None:
    page = httpx.Response(413, text="<html>nginx</html>")
    handler, _ = answers(page, httpx.Response(200, text="<html>login</html>"), httpx.Response(302))
    with client_of(handler) as client:
        with pytest.raises(sc.Refused) as caught:
            client.jobs.get("job_1")
        assert caught.value.code == "http_413"
        for _ in range(2):
            with pytest.raises(sc.UnexpectedAnswer):
                client.jobs.get("job_1")


@pytest.mark.parametrize("change", [{"id": 7}, {"created_at": "soon"}, {"settings": []}, {"state": None}])
def test_answers_that_break_the_contract_are_told(waits: list[float], change: dict[str, object]) -> None:
    handler, _ = answers(httpx.Response(200, json=JOB | change), httpx.Response(200, json=[]))
    with client_of(handler) as client:
        for _ in range(2):
            with pytest.raises(sc.UnexpectedAnswer):
                client.jobs.get("job_1")


def test_contract_may_grow() -> None:
    handler, _ = answers(httpx.Response(200, json=JOB | {"new": 1}))
    with client_of(handler) as client:
        job = client.jobs.get("job_1")
    assert job.raw["new"] == 1
    assert job.created_at.utcoffset() is not None


def test_lists_go_through_all_pages_as_they_are_reached() -> None:
    def page(name: str, after: str | None) -> httpx.Response:
        return httpx.Response(200, json={"items": [JOB | {"id": name}], "next": after})

    handler, seen = answers(page("a", "a"), page("b", "b"), page("c", None))
    with client_of(handler) as client:
        jobs = client.jobs.list(state="queued")
        assert next(jobs).id == "a"
        assert len(seen) == 1
        assert [job.id for job in jobs] == ["b", "c"]
    assert [request.url.params.get("after") for request in seen] == [None, "a", "b"]
    assert {request.url.params["state"] for request in seen} == {"queued"}


def test_requests_say_who_they_are() -> None:
    handler, seen = answers(httpx.Response(200, json=JOB, headers={"X-Correlation-Id": "theirs-1"}), job_answer())
    with client_of(handler) as client:
        client.jobs.get("job/../../keys")
        assert client.correlation_id == "theirs-1"
    with client_of(handler, correlation_id="ward-7.2026-11") as client:
        client.jobs.get("job_1")
    assert seen[0].url.raw_path == b"/base/v1/jobs/job%2F..%2F..%2Fkeys"
    assert seen[0].headers["Authorization"] == f"Bearer {KEY}"
    assert seen[0].headers["User-Agent"].startswith(f"specimap-client/{sc.__version__} ")
    assert seen[1].headers["X-Correlation-Id"] == "ward-7.2026-11"


def test_key_shows_nowhere(waits: list[float]) -> None:
    handler, _ = answers(*[BROKEN] * 4, problem(401, "unauthorized"))
    with client_of(handler) as client:
        texts = [
            repr(client),
            str(client),
            repr(vars(client)),
            repr(client._session),
            repr(client._session._http.headers),
        ]
        for _ in range(2):
            with pytest.raises(sc.SpecimapClientError) as caught:
                client.jobs.get("job_1")
            texts += traceback.format_exception(caught.value)
    with pytest.raises(sc.NotConfigured) as wrong:
        sc.Client("https://specimap.test", KEY + "\n7")
    texts += traceback.format_exception(wrong.value)
    new = sc.NewKey.of({"id": "k", "name": "n", "scopes": [], "created_at": "2026-11-22T06:00:00Z", "key": KEY})
    assert new.key == KEY
    assert all(KEY not in text for text in [*texts, repr(new)])


@pytest.mark.parametrize("url", ["", "specimap.test", "ftp://x", "https://u:p@x", "https://x?a=b", "https://"])
def test_addresses_that_cannot_be_are_refused(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPECIMAP_URL", raising=False)
    with pytest.raises(sc.NotConfigured):
        sc.Client(url, KEY)


def test_address_and_key_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_URL", "https://specimap.test/")
    monkeypatch.setenv("SPECIMAP_KEY", KEY + "\n")
    handler, seen = answers(job_answer())
    with sc.Client(transport=httpx.MockTransport(handler)) as client:
        client.jobs.get("job_1")
    assert str(seen[0].url) == "https://specimap.test/v1/jobs/job_1"
    assert seen[0].headers["Authorization"] == f"Bearer {KEY}"


def test_waits_grow_to_a_cap_and_differ() -> None:
    retries = Retries(first_s=1, cap_s=8)
    for attempt, most in enumerate([1, 2, 4, 8, 8, 8]):
        drawn = [retries.delay(attempt) for _ in range(50)]
        assert most / 2 <= min(drawn) < max(drawn) <= most

"""Answers of a service held against its contract: it says of every operation with which codes it refuses."""

from __future__ import annotations

import re
import threading
from functools import cache
from typing import Any

import httpx

from specimap_service.contract.description import operations
from specimap_service.openapi import document

_lock = threading.Lock()


@cache
def _contract() -> dict[str, Any]:
    return document()


def contract() -> dict[str, Any]:
    """The service's description of itself, made once for this process; nobody changes it."""
    # Several threads that ask at first would each make it, which takes a second.
    with _lock:
        return _contract()


@cache
def _known() -> list[tuple[str, re.Pattern[str], str, dict[str, set[str]]]]:
    described = contract()
    answers: dict[str, Any] = described["components"]["responses"]
    found = []
    for method, path, operation in operations(described):
        codes = {
            status: set(answers[answer["$ref"].rpartition("/")[2]].get("x-codes", ()))
            for status, answer in operation["responses"].items()
            if "$ref" in answer
        }
        pattern = re.compile(re.sub(r"\\{key\\}", ".+", re.sub(r"\\{(?!key)\w+\\}", "[^/]+", re.escape(path))) + "/?")
        found.append((method.upper(), pattern, operation["operationId"], codes))
    return found


def check_refusal(answer: httpx.Response) -> None:
    """Raise AssertionError where an answer refuses with a code that the operation's description does not list."""
    if answer.status_code < 400 or answer.headers.get("content-type") != "application/problem+json":
        return
    answer.read()
    if not answer.content or answer.status_code == 500:
        return
    status, code = str(answer.status_code), answer.json()["code"]
    request = answer.request
    for method, pattern, name, codes in _known():
        if method == request.method and pattern.fullmatch(request.url.path):
            assert code in codes.get(status, ()), f"{name} does not say that it refuses with {status} {code}"
            return

"""docs/api.md against a running service: every command and program on the page is run, in the page's order."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from export_scene import make
from job_scene import queued_job
from result_scene import Result, put_result
from service_scene import ALL_SCOPES, Running, serving
from upload_scene import SAMPLES, photos

from specimap.infra import jobs, webhooks
from specimap.infra.database import Database
from specimap.infra.webhooks import deliver_due, webhook_client

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "api.md"
EXECUTOR = "host:0:page"
SPLIT = 100_000
"""Where the page breaks its upload."""
pytestmark = pytest.mark.skipif(
    shutil.which("bash") is None or shutil.which("curl") is None, reason="bash and curl are not on this machine"
)


def blocks() -> dict[str, list[tuple[str, str]]]:
    """Language and text of the fenced blocks, by the heading that they stand under."""
    found: dict[str, list[tuple[str, str]]] = {}
    for section in re.split(r"^#+ ", PAGE.read_text("utf-8"), flags=re.MULTILINE)[1:]:
        title, _, text = section.partition("\n")
        found[title] = re.findall(r"^```(\w+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return found


@dataclass
class Reader:
    """Somebody who follows the page: a service, a folder, and the variables of a shell."""

    service: Running
    folder: Path
    result: Result
    variables: dict[str, str]
    left: dict[str, list[tuple[str, str]]] = field(default_factory=blocks)

    @property
    def client(self) -> httpx.Client:
        return self.service.clients[0]

    def next(self, title: str, language: str) -> str:
        """The section's next block, which is of this language."""
        found, text = self.left[title].pop(0)
        assert found == language
        return text

    def sh(self, title: str, status: int = 0) -> str:
        """Run the section's next block as a person types it, and give what it prints."""
        functions = "\n".join(re.findall(r"^\w+\(\) \{.*?\}$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL))
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", f"{functions}\n{self.next(title, 'sh')}"], cwd=self.folder,
            env={**os.environ, "NO_PROXY": "127.0.0.1", **self.variables}, capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout

    def python(self, title: str, **names: object) -> dict[str, Any]:
        """Run the section's next program, and give its names."""
        given: dict[str, Any] = {"__name__": "page", **names}
        exec(compile(self.next(title, "python"), str(PAGE), "exec"), given)
        return given


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    folder = tmp_path_factory.mktemp("page")
    with serving(folder / "service", webhook_hosts=["127.0.0.1"]) as service:
        result = put_result(service, folder / "result", specimen_id="SP-2026-0117")
        service.client()
        for number, photo in enumerate(photos()[:7], 1):
            shutil.copy(photo, folder / f"IMG_{number:04d}.jpg")
        for end in ("hdr", "raw"):
            shutil.copy(SAMPLES / "hsi" / f"hsi.{end}", folder / f"scan.{end}")
        variables = {
            "SPECIMAP_URL": service.url, "SPECIMAP_KEY": service.key(ALL_SCOPES), "CLOUD": result.cloud_id,
            "JOB": result.job_id,
        }  # fmt: skip
        yield Reader(service, folder, result, variables)


@pytest.fixture
def here(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> Reader:
    """The reader, and its variables for programs that run in this process."""
    monkeypatch.chdir(reader.folder)
    for name, value in {**reader.variables, "NO_PROXY": "127.0.0.1", "WEBHOOK_SECRET": "0123456789abcdef"}.items():
        monkeypatch.setenv(name, value)
    return reader


def documents(printed: str) -> list[Any]:
    """The JSON documents that commands printed one after the other."""
    decoder, found, at = json.JSONDecoder(), [], 0
    while at < len(printed.rstrip()):
        document, at = decoder.raw_decode(printed, at)
        found.append(document)
    return found


def header(printed: str, name: str) -> str:
    found = re.search(rf"^{name}: (.*?)\r?$", printed, re.MULTILINE | re.IGNORECASE)
    assert found is not None, printed
    return found[1]


def test_keys(reader: Reader) -> None:
    assert reader.sh("The API") == ""
    (made,) = documents(reader.sh("Keys"))
    assert made["scopes"] == ["upload", "read"]
    bearer = {"Authorization": f"Bearer {made['key']}"}
    assert httpx.get(f"{reader.service.url}/v1/jobs", headers=bearer, trust_env=False).status_code == 200
    reader.variables["KEY_ID"] = made["id"]
    assert reader.sh("Keys") == ""
    assert httpx.get(f"{reader.service.url}/v1/jobs", headers=bearer, trust_env=False).status_code == 401


def test_errors(reader: Reader) -> None:
    (told,) = documents(reader.sh("Errors", status=22))
    shown = json.loads(reader.next("Errors", "json"))
    assert {**told, "correlation_id": ""} == {**shown, "correlation_id": ""}
    assert len(told["correlation_id"]) == len(shown["correlation_id"])


def test_from_acquisition_to_job(reader: Reader) -> None:
    made, listed, _ = documents(reader.sh_with_acquisition())
    assert {item["id"] for item in listed["items"]} == {made["id"], reader.result.acquisition_id}


def test_metrics_on_the_page_are_those_of_the_service(reader: Reader) -> None:
    text = reader.client.get("/metrics").text
    served = set(re.findall(r"^# TYPE (\w+) ", text, re.MULTILINE)) - {"specimap_uploads_receive_bytes_created"}
    assert served == set(re.findall(r"`(specimap_\w+)`", PAGE.read_text("utf-8")))

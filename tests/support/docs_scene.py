"""A page of the documents as somebody follows it: its commands in a shell, its programs, one after the other."""

from __future__ import annotations

import json
import os
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from tests.support.places import DOCS
from tests.support.result_scene import Result
from tests.support.service_scene import Running

PAGE = DOCS / "api.md"


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
            ["bash", "-euo", "pipefail", "-c", f"{functions}\n{self.next(title, 'sh')}"],
            cwd=self.folder,
            env={**os.environ, **self.variables},
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout

    def python(self, title: str, **names: object) -> dict[str, Any]:
        """Run the section's next program, and give its names."""
        given: dict[str, Any] = {"__name__": "page", **names}
        exec(compile(self.next(title, "python"), str(PAGE), "exec"), given)
        return given


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

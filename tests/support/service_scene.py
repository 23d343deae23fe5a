"""A running service for tests: a real server on a free port, a real database, a folder as storage."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import httpx
import pytest
import structlog
import uvicorn
from fastapi import FastAPI

from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.logs import SHARED
from specimap_infra.projects import DEFAULT_PROJECT, new_project
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_service.acquisitions import dependencies
from specimap_service.acquisitions.judge import Judge
from specimap_service.app import create_app
from specimap_service.auth.keys import new_key
from specimap_service.auth.people import Granted, known_person
from specimap_service.auth.sessions import new_session
from specimap_service.page_files import FOLDER
from specimap_service.server import server_config
from tests.support.databases import create_tables
from tests.support.documented import check_refusal
from tests.support.plain_http import NO_TLS

ALL_SCOPES = ("upload", "read", "label", "intraoperative", "audit", "admin")


@dataclass
class Running:
    """A service that answers at ``url``."""

    url: str
    settings: ServiceSettings
    app: FastAPI
    server: uvicorn.Server
    clients: list[httpx.Client] = field(default_factory=list)

    @property
    def database(self) -> Database:
        """The app's own database object."""
        database: Database = self.app.state.context.database
        return database

    @property
    def connections(self) -> int:
        """How many connections are open."""
        return len(self.server.server_state.connections)

    @property
    def storage(self) -> Storage:
        """The app's own storage object."""
        storage: Storage = self.app.state.context.storage
        return storage

    def key(self, scopes: Sequence[str] = ALL_SCOPES, *, project: str = DEFAULT_PROJECT, **options: int) -> str:
        """A new key."""
        row, key = new_key("test", scopes, project_id=project, **options)  # type: ignore[arg-type]
        with self.database.session() as session:
            session.add(row)
        return key

    def person_client(self, roles: Sequence[str], projects: Sequence[str] = (DEFAULT_PROJECT,)) -> httpx.Client:
        """A client with the session of a new person who has these roles in these projects; closed with the service."""
        with self.database.session() as session:
            person = known_person(session, "https://idp.test", new_id("person"))
            granted = Granted(person.id, tuple(roles), tuple(projects))
            _, token = new_session(session, person, 1.0, granted=granted.stored())
        headers = {"Cookie": f"specimap_session={token}", "Specimap-Page": "1"}
        return self._client(headers)

    def project(self, name: str) -> str:
        """A new project's id."""
        with self.database.session() as session:
            return new_project(session, name).id

    def client(
        self, scopes: Sequence[str] = ALL_SCOPES, *, project: str = DEFAULT_PROJECT, **options: int
    ) -> httpx.Client:
        """A client with a new key of these scopes; closed with the service."""
        return self._client({"Authorization": f"Bearer {self.key(scopes, project=project, **options)}"})

    def _client(self, headers: dict[str, str]) -> httpx.Client:
        hooks = {"response": [check_refusal]}
        client = httpx.Client(
            base_url=self.url, headers=headers, timeout=60, trust_env=False, verify=NO_TLS, event_hooks=hooks
        )
        self.clients.append(client)
        return client


class SharedJudge(Judge):
    """The judging processes of all services of a test process, since their start takes longer than most tests."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="judging-")
        super().__init__(load_settings(data_dir=self._folder.name), os.environ)

    def close(self) -> None:
        """A service that ends leaves them to the next one."""

    def end(self) -> None:
        """End them."""
        super().close()
        self._folder.cleanup()


@cache
def shared_judge() -> SharedJudge:
    """The one of this process."""
    return SharedJudge()


def pytest_sessionfinish() -> None:
    """End what was started."""
    if shared_judge.cache_info().currsize:
        shared_judge().end()


@contextmanager
def serving(
    folder: Path, *, own_judge: bool = False, pages: Path = FOLDER, bound: int = 0, **given: object
) -> Iterator[Running]:
    """Serve from a folder until the block ends; ``given`` are settings, ``pages`` the folder of the web pages,
    ``bound`` the port, where it must be known before.

    ``own_judge``: with judging processes of its own, for tests of these and of settings that concern them.
    """
    if not structlog.is_configured():
        # The library's own default draws every local variable of a traceback, which takes seconds.
        plain = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
        structlog.configure(processors=[*SHARED, plain])
    # Requests of a whole suite would bury what a failing test prints.
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    settings = load_settings(**{"data_dir": folder, "log_level": "warning", "min_free_bytes": 0, **given})
    database = Database.open(settings.database)
    create_tables(database)
    database.close()
    with mock.patch.object(dependencies, "Judge", Judge if own_judge else lambda *_: shared_judge()):
        app = create_app(settings, pages)
    server = uvicorn.Server(server_config(app, settings, host="127.0.0.1", port=bound))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    deadline = time.monotonic() + 20
    while not server.started:
        assert thread.is_alive()
        assert time.monotonic() < deadline, "the server did not start"
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    running = Running(f"http://127.0.0.1:{port}", settings, app, server)
    try:
        yield running
    finally:
        for client in running.clients:
            client.close()
        server.should_exit = True
        thread.join(timeout=20)
        assert not thread.is_alive(), "the server did not stop"


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Running]:
    """A service of its own for one test."""
    with serving(tmp_path / "service") as running:
        yield running

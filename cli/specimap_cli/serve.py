"""``specimap serve`` and ``specimap worker``."""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable
from contextlib import suppress

import sqlalchemy as sa

from specimap_core.errors import SettingsError
from specimap_core.sandbox import hide_from_others
from specimap_hospital.connections import check_has_work
from specimap_infra.confinement import check_confinement
from specimap_infra.database import Database
from specimap_infra.logs import set_up_logs
from specimap_infra.migrate import exclusive_lock, migrate
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import SCOPES, ApiKey
from specimap_workers.reaper import burier
from specimap_workers.supervisor import Supervisor

HOSPITAL = "specimap_hospital"
"""The module whose process is the hospital's side."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def serve(*, workers: bool, say: Callable[[str], None]) -> None:
    """Run the API, and a worker for each slot, until SIGINT or SIGTERM.

    Raises:
        SettingsError, DatabaseUnavailableError, StorageUnavailableError: before anything was started.
    """
    import uvicorn

    from specimap_service.app import create_app
    from specimap_service.server import keep_collections_short, notice_dead_peers, server_config

    settings = load_settings()
    set_up_logs(settings)
    check_confinement(settings)
    hide_from_others()
    listener = _listen(settings)
    notice_dead_peers(listener, settings.silence_seconds)
    database = Database.open(settings.database)
    try:
        migrate(database)
        Storage.open(settings).check_at_start()
        key = _first_key(database)
    finally:
        database.close()
    app = create_app(settings)
    host, port = listener.getsockname()[:2]
    url = settings.public_url or f"http://{f'[{host}]' if ':' in host else host}:{port}"
    if settings.host not in LOOPBACK:
        say(f"Listening on {settings.host}: put a TLS proxy in front, since keys travel with every request.")
    supervisors = [
        Supervisor(settings.slots if workers else 0, bury=burier(settings)),
        Supervisor(1 if workers and settings.has_hospital_process else 0, module=HOSPITAL),
    ]

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            keep_collections_short()
            say(f"Specimap listens on {url}")
            say(f"The API is described at {url}/docs")
            if key:
                say("First start. This is the administrator's key; it is shown this once and kept nowhere:")
                say(key)

    # The server raises the signal that stopped it again at its end, when the workers have still to be stopped.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    for supervisor in supervisors:
        supervisor.start()
    try:
        Server(server_config(app, settings)).run(sockets=[listener])
    finally:
        for supervisor in supervisors:
            supervisor.stop()


def work(*, slots: int | None, kind: str) -> None:
    """Run workers until SIGINT or SIGTERM.

    Raises:
        SettingsError, DatabaseUnavailableError, StorageUnavailableError: before anything was started.
    """
    settings = load_settings()
    set_up_logs(settings)
    check_confinement(settings)
    hide_from_others()
    database = Database.open(settings.database)
    try:
        migrate(database)
        Storage.open(settings).check_at_start()
    finally:
        database.close()
    _run_until_stopped(Supervisor(slots or settings.slots, ("--kind", kind), burier(settings)))


def run_hospital() -> None:
    """Run the process of the hospital's side until SIGINT or SIGTERM.

    Raises:
        SettingsError: there is nothing for it to do.
        DatabaseUnavailableError, StorageUnavailableError: before anything was started.
    """
    settings = load_settings()
    set_up_logs(settings)
    check_confinement(settings)
    hide_from_others()
    check_has_work(settings)
    database = Database.open(settings.database)
    try:
        migrate(database)
        Storage.open(settings).check_at_start()
    finally:
        database.close()
    _run_until_stopped(Supervisor(1, module=HOSPITAL))


def _run_until_stopped(supervisor: Supervisor) -> None:
    def stop(number: int, _: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    supervisor.start()
    try:
        with suppress(KeyboardInterrupt):
            supervisor.wait()
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        supervisor.stop()


def _listen(settings: ServiceSettings) -> socket.socket:
    """Bind the listening socket, before all else: two services on one port would share a database by accident."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise SettingsError(
            f"{settings.host}:{settings.port} cannot be listened on: {error.strerror}.",
            advice="Another service may use the port: set SPECIMAP_PORT to a free one, or to 0 for any.",
            setting="port",
        ) from error
    listener.set_inheritable(True)
    return listener


def _first_key(database: Database) -> str | None:
    """Create an administrator's key if there is no key at all."""
    from specimap_service.auth.keys import new_key

    with exclusive_lock(database.engine), database.session() as session:
        if session.scalar(sa.select(sa.func.count()).select_from(ApiKey)):
            return None
        row, key = new_key("administrator", SCOPES, project_id=DEFAULT_PROJECT)
        session.add(row)
    return key

"""Making the file of an export: in a process of its own, stored whole, the row written through a fence."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

from specimap_core.errors import CancelledError, SpecimapError
from specimap_core.export.formats import FileFormat, file_name
from specimap_core.sandbox.json_lines import InvalidMessageError, JsonLineProcess, ProcessEndedError, end_text
from specimap_infra.database import Database
from specimap_infra.errors import (
    DatabaseUnavailableError,
    StageTimeoutError,
    StorageUnavailableError,
    WorkerCrashedError,
)
from specimap_infra.logs import logger
from specimap_infra.setbacks import Setbacks, ended_from_outside, pause_seconds
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_workers.export_inputs import LostError, fetch_inputs
from specimap_workers.export_main import REFUSED
from specimap_workers.export_rows import claim, finish, held
from specimap_workers.memory import MemoryWatch, offer_to_memory_killer
from specimap_workers.patience import patience
from specimap_workers.workspaces import Workspace, Workspaces, is_plain

POLL_SECONDS = 0.1
LONGEST_PAUSE_SECONDS = 3.0
"""Longest pause between two processes of an export: another may be in the queue."""
HELD_SECONDS = 2.0
"""How often a running export's row is asked whether it still is this executor's."""


def run_export(
    export_id: str,
    database: Database,
    storage: Storage,
    settings: ServiceSettings,
    executor: str,
    cancelled: Callable[[], bool] = lambda: False,
) -> None:
    """Make the file of an export and finish its row. Blocks; safe to repeat, also while another still works on it.

    A row that is gone, or has ended, is left alone. A process that ends by itself or is killed is started again, as
    often as :mod:`specimap_infra.setbacks` says; where the database or the storage is away, all of it is done again
    once it is back. What goes wrong is in the row, which is then ``failed``.

    Raises:
        CancelledError: ``cancelled`` came true; the row stays as it is, for the worker that takes it up.
    """
    patiently = patience(settings.patience_seconds)
    try:
        patiently(_run, export_id, database, storage, settings, executor, cancelled)
    except StorageUnavailableError as error:
        logger().error("export failed", export=export_id, code=error.code)
        patiently(finish, database, export_id, executor, {"state": "failed", "error": error.as_dict()})


def _run(
    export_id: str,
    database: Database,
    storage: Storage,
    settings: ServiceSettings,
    executor: str,
    cancelled: Callable[[], bool],
) -> None:
    if cancelled():
        raise _stopped()
    export = claim(database, export_id, executor)
    if export is None:
        return
    setbacks = Setbacks.of(export.setbacks)
    if setbacks.cause(crashes=settings.starts, interruptions=settings.interruptions) is not None:
        crashed = _crashed("The worker died", len(setbacks.interruptions), None)
        finish(database, export_id, executor, {"state": "failed", "error": crashed.as_dict()})
        return
    workspaces = Workspaces.of(settings, settings.scratch, "tmp")
    workspace = workspaces.new(f"{export_id}-{uuid4().hex[:8]}")
    try:
        format = FileFormat(export.format)
        target = workspace.own / file_name(export.cloud_id, format)
        labels_hash = fetch_inputs(database, storage, settings, export.cloud_id, format, workspace.given)
        _make(workspaces, workspace, format, target, settings, lambda: held(database, export_id, executor), cancelled)
        # Each attempt has a place of its own: one that lost the row cannot replace the file that the row names.
        key, size = f"exports/{export_id}/{workspace.folder.stem}/{target.name}", target.stat().st_size
        storage.put_file(key, target)
        done = {"state": "succeeded", "storage_key": key, "size": size, "error": None, "labels_hash": labels_hash}
        if not finish(database, export_id, executor, done):
            storage.delete(key)
    except LostError:
        logger().warning("export lost", export=export_id)
    except (CancelledError, DatabaseUnavailableError, StorageUnavailableError):
        raise
    except Exception as error:
        failure = (
            error
            if isinstance(error, SpecimapError)
            else SpecimapError("An error that Specimap does not know.", advice="Report it with the correlation id.")
        )
        logger().error("export failed", export=export_id, code=failure.code, exc_info=error)
        described = failure.as_dict()
        # The path of a scratch folder means nothing to a client.
        for folder in (workspace.own, workspace.given, workspace.folder):
            described["message"] = str(described["message"]).replace(f"{folder}/", "")
        finish(database, export_id, executor, {"state": "failed", "error": described})
    finally:
        workspace.remove()


# ---- the file -----------------------------------------------------------------------------------------


def _make(
    workspaces: Workspaces,
    workspace: Workspace,
    format: FileFormat,
    target: Path,
    settings: ServiceSettings,
    held: Callable[[], bool],
    cancelled: Callable[[], bool],
) -> None:
    """Run :mod:`specimap_workers.export_main`, again where it dies.

    Raises:
        SpecimapError: what it raised there, or WorkerCrashedError, StageTimeoutError, CancelledError.
        LostError: the row is another's.
    """
    setbacks = Setbacks()
    while True:
        memory = MemoryWatch()
        status, error = _run_once(workspaces, workspace, format, target, settings, held, cancelled)
        if status == 0 and is_plain(workspace.own):
            return
        if status == REFUSED:
            raise _RefusedError(error)
        logger().warning("export process ended", format=format.value, status=status)
        name = uuid4().hex[:12]
        outside = ended_from_outside(status, memory_ran_out=memory.ran_out())
        setbacks = setbacks.interrupted(name, 0) if outside else setbacks.crashed(name)
        if setbacks.cause(crashes=settings.starts, interruptions=settings.interruptions) is not None:
            count = len(setbacks.interruptions if outside else setbacks.crashes)
            raise _crashed(f"The process that made the file ended {end_text(status)}", count, status)
        if outside:
            time.sleep(min(pause_seconds(len(setbacks.interruptions)), LONGEST_PAUSE_SECONDS))


def _stopped() -> CancelledError:
    return CancelledError("The export was stopped.", advice="It is made when a worker takes it up again.")


def _crashed(what: str, count: int, status: int | None) -> WorkerCrashedError:
    return WorkerCrashedError(
        f"{what}, {count} times.",
        advice="A worker with more memory may help; the log says more.",
        stage="export",
        status=status,
    )


class _RefusedError(SpecimapError):
    """An error of the process, as it described it."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(error["message"], advice=error["advice"], **error["details"])
        self.code = error["code"]  # type: ignore[misc]


def _run_once(
    workspaces: Workspaces,
    workspace: Workspace,
    format: FileFormat,
    target: Path,
    settings: ServiceSettings,
    held: Callable[[], bool],
    cancelled: Callable[[], bool],
) -> tuple[int, dict[str, Any]]:
    """The exit status of one process, and the error that it described."""
    command = [
        sys.executable,
        "-m",
        "specimap_workers.export_main",
        str(workspace.given),
        format.value,
        str(target),
        str(os.getpid()),
        str(settings.stage_memory_bytes),
    ]
    error: dict[str, Any] = {}
    start = asked = time.monotonic()
    # It holds no file of the worker's: it could empty that of the log.
    with JsonLineProcess(
        workspaces.confined(command, workspace, backends=False),
        env=workspaces.environment(workspace),
        takes_messages=False,
    ) as process:
        offer_to_memory_killer(process.pid)
        while True:
            try:
                error = process.receive(POLL_SECONDS)
            except (TimeoutError, InvalidMessageError):
                pass
            except ProcessEndedError as end:
                if end.status not in (0, REFUSED):
                    logger().error("export's process ended", status=end.status, last_lines=end.tail)
                return end.status, error
            now = time.monotonic()
            if cancelled():
                raise _stopped()
            if now - start > settings.stage_seconds:
                raise StageTimeoutError(
                    f"The export took longer than {settings.stage_seconds:.0f} s.",
                    advice="Raise SPECIMAP_STAGE_SECONDS.",
                    stage="export",
                )
            if now - asked > HELD_SECONDS:
                asked = now
                if not held():
                    raise LostError

"""Reading DICOM objects that came in, in a process that reaches them and a folder for its answer alone."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from specimap_core.atomic import disk_errors
from specimap_core.sandbox import Reach, confined
from specimap_core.sandbox.environment import bare_environment
from specimap_core.sandbox.json_lines import InvalidMessageError, JsonLineProcess, ProcessEndedError
from specimap_hospital.receive.classes import CANNOT_UNDERSTAND
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings

READ_SECONDS = 120.0
START_SECONDS = 60.0
MEMORY_BYTES = 4 * 1024**3


class UnreadableError(Exception):
    """An object that is not taken: ``failure``, a code of DICOM."""

    def __init__(self, failure: int) -> None:
        super().__init__(f"{failure:04x}")
        self.failure = failure


def ask_reader(settings: ServiceSettings, request: dict[str, Any], out: Path, read: Sequence[Path]) -> dict[str, Any]:
    """Have a request of :mod:`specimap_hospital.receive.read_main` answered, with what it writes in the folder ``out``.

    ``read``: what the process may read. The answer comes from a process that a file may have taken over.

    Raises:
        UnreadableError: what was read is not taken, or ended the process.
    """
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
    reach = Reach(read=list(read), write=[out], keep_from=settings.private_places)
    command = [
        sys.executable,
        "-m",
        "specimap_hospital.receive.read_main",
        str(os.getpid()),
        str(settings.stage_memory_bytes or MEMORY_BYTES),
    ]
    environment = {**bare_environment(), "TMPDIR": str(out)}
    started = time.monotonic()
    with JsonLineProcess(confined(command, reach, settings.sandbox), env=environment) as process:
        try:
            process.send({**request, "out": str(out)}, START_SECONDS)
            answer = process.receive(READ_SECONDS)
        except (TimeoutError, InvalidMessageError, ProcessEndedError):
            logger().warning("dicom object ended its reader", seconds=round(time.monotonic() - started, 1))
            raise UnreadableError(CANNOT_UNDERSTAND) from None
    failure = answer.get("failure")
    if failure is not None:
        raise UnreadableError(failure if isinstance(failure, int) and 0 < failure <= 0xFFFF else CANNOT_UNDERSTAND)
    return answer

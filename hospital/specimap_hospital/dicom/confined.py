"""Building DICOM objects in a process of its own that reaches the result, the photos and the output folder alone.

Light: the DICOM libraries are loaded in that process.
"""

from __future__ import annotations

import os
import re
import stat
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from specimap_core.atomic import disk_errors
from specimap_core.errors import CancelledError, SpecimapError
from specimap_core.sandbox import Mode, Reach, confined
from specimap_core.sandbox.environment import bare_environment
from specimap_core.sandbox.json_lines import InvalidMessageError, JsonLineProcess, ProcessEndedError, end_text
from specimap_core.sandbox.process import leaf_of
from specimap_hospital.dicom.model import KINDS, BuildTask, DicomObject, LeftOut, ResultSource
from specimap_hospital.dicom.uids import study_uid
from specimap_infra.errors import StageTimeoutError, WorkerCrashedError
from specimap_infra.study_context import StudyContext

POLL_SECONDS = 0.1
REQUEST_SECONDS = 60.0
"""Longest wait for the process to take its request: it loads its libraries before."""
_UID = re.compile(r"^[0-9.]{1,64}$")


@dataclass(frozen=True)
class Limits:
    """``sandbox``: how strictly the process is confined (SPECIMAP_SANDBOX). ``keep_from``: places that it must not
    reach though its program lies next to them. ``memory_bytes``: 0 for no limit. ``seconds``: for the whole."""

    sandbox: Mode = "best-effort"
    keep_from: Sequence[Path] = ()
    memory_bytes: int = 0
    seconds: float = 900.0


def build_confined(
    task: BuildTask,
    context: StudyContext,
    source: ResultSource,
    out: Path,
    limits: Limits | None = None,
    *,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
    left_out: Callable[[LeftOut], None] = lambda photo: None,
) -> list[DicomObject]:
    """Build what ``task`` says into the folder ``out``, which is made where it is not there.

    ``progress`` and ``cancelled`` are called ten times a second or so; what ``progress`` raises ends the process, too.

    Raises:
        CancelledError: ``cancelled`` came true.
        StageTimeoutError: it took longer than ``limits.seconds``.
        WorkerCrashedError: the process ended without an answer, or gave one that is none.
        MemoryExhaustedError, StageFailedError: it ran out of memory; a library failed.
        SpecimapError: as the functions of :mod:`specimap_hospital.dicom.build`.
    """
    limits = limits or Limits()
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
    out = out.resolve()
    request = {
        "task": task.as_dict(),
        "context": context.model_dump(mode="json"),
        "source": source.as_dict(),
        "out": str(out),
    }
    with TemporaryDirectory(prefix=".dicom-", suffix=".tmp", dir=out.parent) as scratch:
        reach = Reach(
            read=[source.folder, *source.photos.values()], write=[out, Path(scratch)], keep_from=limits.keep_from
        )
        command = [
            sys.executable,
            "-m",
            "specimap_hospital.dicom.build_main",
            str(os.getpid()),
            str(limits.memory_bytes),
        ]
        environment = {**bare_environment(), "TMPDIR": scratch}
        with JsonLineProcess(confined(command, reach, limits.sandbox), env=environment) as process:
            try:
                process.send(request, REQUEST_SECONDS)
            except TimeoutError:
                raise _crashed("did not take its request", None) from None
            return _answer(process, limits, progress, cancelled, left_out, study_uid(context, source), out)


def _answer(
    process: JsonLineProcess,
    limits: Limits,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
    left_out: Callable[[LeftOut], None],
    study: str,
    out: Path,
) -> list[DicomObject]:
    start, done = time.monotonic(), 0.0
    while True:
        if cancelled():
            raise CancelledError("The building of DICOM objects was stopped.", advice="Start it again.")
        if time.monotonic() - start > limits.seconds:
            raise StageTimeoutError(
                f"The building of DICOM objects took longer than {limits.seconds:.0f} s.",
                advice="Allow it more time.",
                stage="dicom",
            )
        progress(done)
        try:
            line = process.receive(POLL_SECONDS)
        except TimeoutError:
            continue
        except InvalidMessageError:
            raise _crashed("gave an answer that is none", None) from None
        except ProcessEndedError as end:
            raise _crashed(f"ended {end_text(end.status)} without an answer", end.status) from end
        # The process may have been taken over by a photo: nothing in a line is taken on trust.
        try:
            if "progress" in line:
                done = min(max(float(line["progress"]), done), 1.0)
            elif "left_out" in line:
                left_out(_left_out(line["left_out"]))
            elif "error" in line:
                raise _error(line["error"])
            elif "objects" in line:
                return [_object(values, study, out) for values in line["objects"]]
        except (TypeError, ValueError, KeyError, AttributeError, OSError) as error:
            if isinstance(error, SpecimapError):
                raise
            raise _crashed("gave an answer that is none", None) from error


def _object(values: dict[str, str], study: str, out: Path) -> DicomObject:
    """An object as it was described.

    Raises:
        ValueError: it is none: in another study, or no plain file of the folder.
    """
    made = DicomObject.from_dict({name: str(value) for name, value in values.items()})
    uids = made.sop_class_uid, made.sop_instance_uid, made.series_uid
    if made.kind not in KINDS or made.study_uid != study or not all(map(_UID.match, uids)):
        raise ValueError("it describes another object")
    if made.path.parent != out or not stat.S_ISREG(os.lstat(made.path).st_mode):
        raise ValueError("it names no file of the folder")
    return made


def _left_out(values: dict[str, Any]) -> LeftOut:
    return LeftOut(int(values["photo"]), str(values["code"])[:64], str(values["message"])[:500])


def _error(fields: dict[str, Any]) -> SpecimapError:
    leaf = leaf_of(str(fields["code"])) or SpecimapError
    return leaf(str(fields["message"]), advice=str(fields["advice"]), **fields["details"])


def _crashed(what: str, status: int | None) -> WorkerCrashedError:
    return WorkerCrashedError(
        f"The process that builds DICOM objects {what}.",
        advice="Try it again; more memory may help, and the log says more.",
        stage="dicom",
        status=status,
    )

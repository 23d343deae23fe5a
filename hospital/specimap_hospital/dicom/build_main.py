"""The builder's own process: reads one request, writes DICOM files, and ends. It needs neither database nor network.

The request comes as a JSON line on standard input, since it holds patient data, which a command line would show to
everybody on the machine. Answers are JSON lines: ``progress``, ``left_out``, and at the end ``objects`` or ``error``.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from specimap_core.errors import MemoryExhaustedError, SpecimapError, StageFailedError
from specimap_core.json_text import json_text
from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads
from specimap_hospital.dicom.model import BuildTask, DicomObject, ResultSource
from specimap_infra.study_context import StudyContext


def build(request: Mapping[str, Any], say: Any) -> list[DicomObject]:
    """Do what a request asks; ``say`` takes the lines before the last.

    Raises:
        SpecimapError: as the functions of :mod:`specimap_hospital.dicom.build`.
    """
    # Imported late, since they load the DICOM libraries.
    from specimap_hospital.dicom import build as builder
    from specimap_hospital.dicom.archive import write_zip

    context = StudyContext.model_validate(request["context"])
    source, task, out = ResultSource.from_dict(request["source"]), BuildTask.from_dict(request["task"]), request["out"]
    folder = Path(out)

    def progress(share: float) -> None:
        say({"progress": share})

    if task.what == "parametric_map":
        objects = builder.build_parametric_map(context, source, folder, task.choice, progress)
    elif task.what == "segmentation":
        objects = builder.build_segmentation(context, source, folder, task.label, task.classes, progress)
    else:
        objects = builder.build_first_set(
            context, source, folder, progress, lambda photo: say({"left_out": vars(photo)})
        )
    if task.archive:
        write_zip(objects, folder / task.archive)
    return objects


def _out_of_memory(error: Exception, limit: int) -> bool:
    """Whether it is the limit that stopped the process: libraries that do not fit fail to be loaded."""
    return isinstance(error, MemoryError) or bool(limit and isinstance(error, ImportError | OSError))


def main(arguments: list[str]) -> int:
    """Answer one request. Arguments: the parent's process id, most bytes of memory (0: no limit)."""
    limit_blas_threads()
    parent, memory = arguments
    die_with(int(parent))
    if int(memory):
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    # Libraries that print would spoil the answer.
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)

    def say(line: Mapping[str, object]) -> None:
        answer.write(json_text(line) + "\n")

    try:
        request = json.loads(sys.stdin.readline())
        say({"objects": [made.as_dict() for made in build(request, say)]})
    except SpecimapError as error:
        say({"error": error.as_dict()})
    except Exception as error:
        if _out_of_memory(error, int(memory)):
            refused = MemoryExhaustedError(
                "The DICOM objects need more memory than they may take.", advice="Allow the process more memory."
            )
            say({"error": refused.as_dict()})
            return 0
        # No text of the error, which may hold a value of the study context; and the trace without values goes to the
        # log of whoever started this.
        traceback.print_tb(error.__traceback__)
        say(
            {
                "error": StageFailedError(
                    f"The DICOM objects could not be built: {type(error).__name__}.",
                    advice="Report it with the last lines of the log.",
                    stage="dicom",
                ).as_dict()
            }
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Turn what a library raises inside a stage into an error of ours: its own text may hold paths, and helps no user."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from specimap_core.errors import MemoryExhaustedError, SpecimapError, StageFailedError

_ADVICE = {
    "reconstruct": "Check that the photos are of one unmoved scene and show the markers whole and sharp",
    "adjust": "Check that the photos are of one unmoved scene and that the markers' edge is given in millimetres",
    "render": "Check that the markers' edge and the grid's cells are given in millimetres",
    "register": "Check that the cube shows the same specimen and markers as the photos",
}


@contextmanager
def as_stage_failure(stage: str) -> Iterator[None]:
    """Raise StageFailedError for whatever a library raises within, MemoryExhaustedError where memory ran out.

    Leaves of SpecimapError pass, and so do the system's errors (OSError), which another attempt may not meet. The
    original stays the cause, for ``--debug`` and logs.
    """
    try:
        yield
    except (SpecimapError, OSError):
        raise
    except MemoryError as error:
        raise MemoryExhaustedError(
            f"Stage {stage} needs more memory than it may take.",
            advice="Give it more memory, or use fewer or smaller photos (--working-px). Finished stages are kept.",
            stage=stage,
        ) from error
    except Exception as error:
        # Not a list of types: OpenCV, Open3D, COLMAP and NumPy share none.
        raise StageFailedError(
            f"Stage {stage} met an input that it cannot work with ({type(error).__name__}).",
            advice=f"{_ADVICE[stage]}. If they are as they should be, report this. Finished stages are kept.",
            stage=stage,
            cause=type(error).__name__,
        ) from error

"""Progress of a part as progress of the whole."""

from __future__ import annotations

from collections.abc import Callable


def within(progress: Callable[[float], None], start: float, end: float) -> Callable[[float], None]:
    """Progress of a part, 0..1, as progress of the whole between ``start`` and ``end``."""
    return lambda share: progress(start + (end - start) * share)

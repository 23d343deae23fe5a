"""The verdict on one file: usable or not, why, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Word = Literal["accepted", "doubtful", "refused"]


@dataclass(frozen=True)
class Verdict:
    """``accepted``, ``doubtful`` (usable, but better retaken) or ``refused`` (no job can use it).

    ``code`` is None for a file without faults. ``facts`` are JSON values found in the file.
    """

    verdict: Word = "accepted"
    code: str | None = None
    reason: str = ""
    advice: str = ""
    facts: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """All in one object of JSON values."""
        words = {"verdict": self.verdict, "code": self.code, "reason": self.reason, "advice": self.advice}
        return {**words, **self.facts}

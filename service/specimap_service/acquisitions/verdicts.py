"""Checks of a judging child's answer: it has read bytes from outside, and may have been taken over by them."""

from __future__ import annotations

import math
import re
from typing import Any

from specimap_service.acquisitions.schemas import CubeJudgement, PhotoJudgement

LONGEST_TEXT = 1000
MOST_ITEMS = 2000
DEEPEST = 5
LARGEST_NUMBER = 2**53
WAVELENGTHS_NM = (1.0, 1e7)
"""Beyond lie X-rays and microwaves, which no cube records."""
SUFFIX = re.compile(r"\.[a-z0-9]{1,8}")
CODE = re.compile(r"[a-z0-9_]{1,64}")
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]+")
_MODELS: dict[str, type[PhotoJudgement | CubeJudgement]] = {
    "photo": PhotoJudgement,
    "part": CubeJudgement,
    "cube": CubeJudgement,
}


def checked_verdict(kind: str, answer: object) -> dict[str, Any]:
    """The verdict on a ``kind`` of task (photo, part, cube), its texts shortened, its wavelengths plausible or None.

    Raises:
        ValueError: no reader gives such an answer.
    """
    verdict = _bounded(answer, 0)
    if not isinstance(verdict, dict):
        raise ValueError("no verdict")
    if kind != "cube" and SUFFIX.fullmatch(str(verdict.get("suffix"))) is None:
        raise ValueError("no suffix")
    if verdict.get("code") is not None and CODE.fullmatch(str(verdict["code"])) is None:
        raise ValueError("no code")
    if "wavelength_nm" in verdict:
        verdict["wavelength_nm"] = _wavelengths(verdict["wavelength_nm"])
    # pydantic's error is a ValueError.
    _MODELS[kind].model_validate({"part": "whole", **verdict} if kind == "cube" else verdict)
    return verdict


def _wavelengths(given: object) -> list[float] | None:
    match given:
        case [int() | float() as low, int() | float() as high]:
            return [low, high] if WAVELENGTHS_NM[0] <= low <= high <= WAVELENGTHS_NM[1] else None
    return None


def _bounded(value: object, depth: int) -> Any:
    match value:
        case None | bool():
            return value
        case int() | float():
            if not math.isfinite(value) or abs(value) > LARGEST_NUMBER:
                raise ValueError("no number")
            return value
        case str():
            return _CONTROLS.sub(" ", value[:LONGEST_TEXT])
        case list() | dict() if len(value) <= MOST_ITEMS and depth < DEEPEST:
            if isinstance(value, list):
                return [_bounded(item, depth + 1) for item in value]
            return {str(name)[:64]: _bounded(item, depth + 1) for name, item in value.items()}
    raise ValueError("too much, or too deep")

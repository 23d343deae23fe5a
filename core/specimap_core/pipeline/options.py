"""The choices of a run: of each its default, what it takes and what it means, in one place.

The command line, a job's settings and an acquisition take them from here. Nothing heavy is imported, so that the
service can.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

from specimap_core.errors import SettingsError

Dictionary = Literal[
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16h5",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_36h10",
    "DICT_APRILTAG_36h11",
    "DICT_ARUCO_MIP_36h12",
]
"""OpenCV's predefined dictionaries, named here so that no service needs OpenCV to check a name."""
Method = Literal["camera", "homography"]
Adjustment = Literal["rigid", "free"]
Backend = Literal["colmap", "mast3r", "da3"]
Features = Literal["auto", "sift", "aliked"]

OTHER_UNITS = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0}
"""Units that an edge is given in by mistake, in millimetres."""
USUAL_EDGE_MM = (3.0, 100.0)


@dataclass(frozen=True)
class Option:
    """Meaning of a choice, with what it takes: one of ``choices``, or a number within ``bounds``, ends included."""

    meaning: str
    bounds: tuple[float, float] = (-math.inf, math.inf)
    choices: tuple[str, ...] = ()


def _number(low: float, high: float, meaning: str) -> dict[str, Option]:
    return {"option": Option(meaning, bounds=(low, high))}


def _choice(choices: object, meaning: str) -> dict[str, Option]:
    return {"option": Option(meaning, choices=get_args(choices))}


@dataclass(frozen=True)
class RunOptions:
    """What a person chooses of a run, in the order of the stages that it concerns."""

    edge_mm: float = field(default=6.8, metadata=_number(0.5, 200.0, "Edge of a marker's black square, mm."))
    dictionary: str = field(default="DICT_4X4_50", metadata=_choice(Dictionary, "The markers' ArUco dictionary."))
    r_reg: float = field(default=2.0, metadata=_number(0.05, 20.0, "Cell of the coarse grid, mm."))
    r_pc: float = field(default=0.5, metadata=_number(0.05, 20.0, "Cell of the fine grid, mm."))
    working_px: int = field(
        default=1280, metadata=_number(320, 8192, "Longer side that larger photos are brought to, pixels.")
    )
    backend: Backend = field(
        default="colmap",
        metadata=_choice(Backend, "Reconstruction backend; the learned ones need weights on the worker."),
    )
    features: Features = field(
        default="auto", metadata=_choice(Features, "Features that locate photos which the markers leave open.")
    )
    method: Method = field(
        default="camera",
        metadata=_choice(Method, "`camera` removes parallax; `homography` is the published one."),
    )
    adjustment: Adjustment = field(
        default="rigid", metadata=_choice(Adjustment, "`rigid` squares, or `free` corners as published.")
    )

    def check(self) -> None:
        """Refuse values that cannot work, but for the dictionary, which OpenCV knows by more names than are listed.

        Raises:
            SettingsError: a value is out of its range, or no choice; details name it.
        """
        for name, option in OPTIONS.items():
            value = getattr(self, name)
            if not option.choices:
                check_number(name, value, option.bounds)
            elif name != "dictionary":
                check_choice(name, value, option.choices)


OPTIONS: dict[str, Option] = {part.name: part.metadata["option"] for part in fields(RunOptions)}
"""The options of a run by their names."""
DEFAULTS = RunOptions()


def check_number(name: str, value: float, bounds: tuple[float, float]) -> None:
    """Raise SettingsError where a setting's value is not within ``bounds``."""
    low, high = bounds
    if low <= value <= high:
        return
    advice = f"Give a number from {low:g} to {high:g}."
    if name == "edge_mm":
        guesses = _as_if_in_mm(value) if value < low else []
        likely = f": that is {', '.join(guesses)}" if guesses else ""
        advice = f"Give the edge of a marker's black square in millimetres{likely}."
    raise SettingsError(f"{name} is {value:g}; it must be from {low:g} to {high:g}.", advice=advice, setting=name)


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise SettingsError where a setting's value is none of ``choices``."""
    if value not in choices:
        raise SettingsError(
            f"There is no {name} {value!r}.", advice=f"Choose one of: {', '.join(choices)}.", setting=name
        )


def _as_if_in_mm(edge: float) -> list[str]:
    """An edge in millimetres by each unit that makes it a usual one: parts of a sentence."""
    low, high = USUAL_EDGE_MM
    return [
        f"{edge * factor:.4g} if it is in {unit}"
        for unit, factor in OTHER_UNITS.items()
        if low <= edge * factor <= high
    ]

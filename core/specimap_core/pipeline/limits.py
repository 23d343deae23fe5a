"""The ranges of a run's numbers: the command line, a job's settings and an acquisition refuse by the same."""

from __future__ import annotations

RANGES: dict[str, tuple[float, float]] = {
    "edge_mm": (0.5, 200.0),
    "r_pc": (0.05, 20.0),
    "r_reg": (0.05, 20.0),
    "working_px": (320, 8192),
    "voxel_mm": (0.005, 50.0),
}
OTHER_UNITS = {"metres": 1000.0, "inches": 25.4, "centimetres": 10.0}
"""Units that an edge is given in by mistake, in millimetres."""
USUAL_EDGE_MM = (3.0, 100.0)


def as_if_in_mm(edge: float, low: float = USUAL_EDGE_MM[0], high: float = USUAL_EDGE_MM[1]) -> list[str]:
    """What an edge would be in mm, ``low`` to ``high``, were it given in another unit: sentences' parts."""
    return [
        f"{edge * factor:.4g} if it is in {unit}"
        for unit, factor in OTHER_UNITS.items()
        if low <= edge * factor <= high
    ]


def advice_on(name: str, value: float) -> str:
    """What to give in place of a value that is out of range."""
    low, high = RANGES[name]
    if name == "edge_mm":
        guesses = as_if_in_mm(value) if value < low else []
        likely = f": that is {', '.join(guesses)}" if guesses else ""
        return f"Give the edge of a marker's black square in millimetres{likely}."
    return f"Give a number from {low:g} to {high:g}."

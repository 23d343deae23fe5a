"""What the report says of a network that ran."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from specimap_core.reconstruct.backends.weights import Weights

Remark = tuple[str, str]


def ran(what: str, facts: Mapping[str, Any], weights: Weights) -> Remark:
    """Device, time and weights; ``facts`` as the network's process tells them."""
    memory = facts.get("device_memory_bytes", 0)
    took = f", with {memory / 1e9:.1f} GB of its memory" if memory else ""
    pinned = "pinned" if weights.pinned else "not pinned"
    return (
        "backend_run",
        f"{what} ran {facts['seconds']:.0f} s on {facts['device']}{took} (torch {facts['torch']}); "
        f"sha256 of its weights, {pinned}: {weights.sha256}.",
    )


def left_out(what: str, fits: str, names: Sequence[str], of: int) -> list[Remark]:
    """Photos, by their ``names``, whose depth does not fit ``fits``; nothing where there are none."""
    if not names:
        return []
    text = f"{what}'s depth of {len(names)} of {of} photos does not fit {fits} and is left out: {', '.join(names)}."
    return [("depth_unaligned", text)]

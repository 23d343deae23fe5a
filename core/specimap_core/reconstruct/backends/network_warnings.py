"""Warnings about a network that ran."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from specimap_core.notices import Notice
from specimap_core.reconstruct.backends.weights import Weights


def backend_run(network: str, facts: Mapping[str, Any], weights: Weights) -> Notice:
    """Device, time and weights; ``facts`` as the network's process reports them."""
    memory = facts.get("device_memory_bytes", 0)
    took = f", with {memory / 1e9:.1f} GB of its memory" if memory else ""
    pinned = "pinned" if weights.pinned else "not pinned"
    return Notice(
        "backend_run",
        f"{network} ran {facts['seconds']:.0f} s on {facts['device']}{took} (torch {facts['torch']}); "
        f"sha256 of its weights, {pinned}: {weights.sha256}.",
    )


def depth_unaligned(network: str, reference: str, names: Sequence[str], of: int) -> list[Notice]:
    """Photos, by their ``names``, whose depth does not fit the ``reference``; nothing where there are none."""
    if not names:
        return []
    text = f"{network}'s depth of {len(names)} of {of} photos does not fit {reference} and is left out: "
    return [Notice("depth_unaligned", f"{text}{', '.join(names)}.")]

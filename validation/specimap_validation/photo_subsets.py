"""Subsets of an acquisition's photos, chosen evenly or at random."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def even_subset(items: Sequence[Path], share: float) -> list[Path]:
    """Choose a share of ``items``; those left out are spread evenly."""
    count = round(share * len(items))
    return [items[k] for k in np.floor((np.arange(count) + 0.5) * len(items) / count).astype(int)]


def random_subset(items: Sequence[Path], share: float, seed: int) -> list[Path]:
    """Choose a random share of ``items``, in their order; the same ``seed`` gives the same subset."""
    count = round(share * len(items))
    chosen = np.random.default_rng([seed, count]).choice(len(items), count, replace=False)
    return [items[k] for k in np.sort(chosen)]

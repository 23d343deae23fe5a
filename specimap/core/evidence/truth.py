"""A finished run against a phantom's truth; which photos a smaller run keeps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from specimap.core.accuracy import TruthComparison, compare_with_truth
from specimap.core.cloud import Cloud
from specimap.core.phantom import load_truth

SPECIMEN = 1
"""Class of the specimen in a phantom's truth."""


def evenly(items: Sequence[Path], share: float) -> list[Path]:
    """A share of ``items``, those left out spread evenly."""
    count = round(share * len(items))
    return [items[k] for k in np.floor((np.arange(count) + 0.5) * len(items) / count).astype(int)]


def judge(out: Path, folder: Path) -> TruthComparison:
    """The cloud of a finished run in ``out`` against the truth in ``folder``."""
    truth, cloud = load_truth(folder), Cloud.open(out / "cloud.zarr")
    corners = json.loads((out / "corners.json").read_text(encoding="utf-8"))
    both = [k for k, i in enumerate(truth.marker_ids) if str(i) in corners]
    return compare_with_truth(
        cloud.hsi_pixel, cloud.xyz, np.array([corners[str(truth.marker_ids[k])] for k in both]),
        truth.marker_corners[both], truth.hsi_xyz.astype(float), truth.hsi_class == SPECIMEN,
    )  # fmt: skip

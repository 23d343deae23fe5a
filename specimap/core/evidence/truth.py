"""A finished run against a phantom's truth; which photos a smaller run keeps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap.core.accuracy import TruthComparison, compare_with_truth
from specimap.core.cloud import Cloud
from specimap.core.errors import SettingsError
from specimap.core.geometry import Floats
from specimap.core.phantom import load_truth

SPECIMEN = 1
"""Class of the specimen in a phantom's truth."""


def evenly(items: Sequence[Path], share: float) -> list[Path]:
    """A share of ``items``, those left out spread evenly."""
    count = round(share * len(items))
    return [items[k] for k in np.floor((np.arange(count) + 0.5) * len(items) / count).astype(int)]


def some(items: Sequence[Path], share: float, seed: int) -> list[Path]:
    """A random share of ``items`` in their order; the same ``seed`` gives the same."""
    count = round(share * len(items))
    chosen = np.random.default_rng([seed, count]).choice(len(items), count, replace=False)
    return [items[k] for k in np.sort(chosen)]


@dataclass(frozen=True, eq=False)
class Judged:
    """A run's ``errors`` against truth, the ``points`` (n,) of its cloud that they are of, and ``sigma_mm`` (n,), their
    stated standard deviation."""

    errors: TruthComparison
    points: NDArray[np.intp]
    sigma_mm: NDArray[np.float32]

    @property
    def errors_mm(self) -> Floats:
        """(n,) distance of each point from where its pixel truly looked."""
        return self.errors.errors_mm

    def within(self, sigmas: float) -> float:
        """Share of the errors within so many stated standard deviations."""
        return float((self.errors_mm <= sigmas * self.sigma_mm).mean())


def judge(out: Path, folder: Path) -> TruthComparison:
    """The cloud of a finished run in ``out`` against the truth in ``folder``."""
    return judge_with_sigma(out, folder).errors


def judge_with_sigma(out: Path, folder: Path) -> Judged:
    """As :func:`judge`, with what the run itself says of its errors.

    Raises:
        NotFoundError: there is no truth.
        SettingsError: the truth is of another acquisition.
    """
    truth, cloud = load_truth(folder), Cloud.open(out / "cloud.zarr")
    corners = json.loads((out / "corners.json").read_text(encoding="utf-8"))
    both = [k for k, i in enumerate(truth.marker_ids) if str(i) in corners]
    pixels, xyz, true_xyz = cloud.hsi_pixel, cloud.xyz, truth.hsi_xyz.astype(float)
    if not both or (pixels.max(0) >= truth.hsi_class.shape).any():
        raise SettingsError(
            f"{folder} is not the truth of this run: its markers or its cube are others.",
            advice="Give the truth.npz of the phantom that the photos and the cube came from.",
            setting="truth",
        )
    # Errors come without the points that have no finite one: left out here, they leave sigma in step.
    finite = np.isfinite(xyz).all(1) & np.isfinite(true_xyz[pixels[:, 0], pixels[:, 1]]).all(1)
    points = np.flatnonzero(finite & (truth.hsi_class[pixels[:, 0], pixels[:, 1]] == SPECIMEN))
    errors = compare_with_truth(
        pixels[points],
        xyz[points],
        np.array([corners[str(truth.marker_ids[k])] for k in both]),
        truth.marker_corners[both],
        true_xyz,
        truth.hsi_class == SPECIMEN,
    )
    return Judged(errors, points, cloud.sigma_mm[points])

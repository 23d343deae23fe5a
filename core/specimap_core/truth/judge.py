"""A finished run against a phantom's truth; which photos a smaller run keeps."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.cloud import Cloud
from specimap_core.errors import SettingsError
from specimap_core.geometry.cameras import fit_similarity
from specimap_core.truth.truth_file import load_truth

SPECIMEN = 1
"""Class of the specimen in a phantom's truth."""


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


@dataclass(frozen=True)
class TruthComparison:
    """A cloud against truth, after a rigid fit of its corners to the true ones.

    ``errors_mm`` (n,): distance of each specimen pixel's point from where that pixel truly looks; ``coverage``:
    share of the specimen's pixels that have a point; ``scale``: size of the result over the true one, less 1;
    ``corner_mm``: median distance of the corners after the fit.
    """

    errors_mm: Floats
    coverage: float
    scale: float
    corner_mm: float

    @property
    def median(self) -> float:
        """Median error, mm."""
        return float(np.median(self.errors_mm))

    @property
    def p95(self) -> float:
        """95th percentile of the error, mm."""
        return float(np.percentile(self.errors_mm, 95))


def compare_with_truth(
    pixels: NDArray[np.uint16],
    xyz: NDArray[np.float32],
    corners: Floats,
    true_corners: Floats,
    true_xyz: Floats,
    true_specimen: NDArray[np.bool_],
) -> TruthComparison:
    """Compare points ``xyz`` (S, 3) of cube ``pixels`` (S, 2) with truth.

    ``corners``, ``true_corners`` (Q, 4, 3) mm of the same markers; ``true_xyz`` (H, W, 3) first surface hit of each
    pixel's ray; ``true_specimen`` (H, W).
    """
    found, truth = corners.reshape(-1, 3), true_corners.reshape(-1, 3)
    _, R, t = fit_similarity(found, truth)
    size, _, _ = fit_similarity(truth, found, with_scale=True)
    on_it = true_specimen[pixels[:, 0], pixels[:, 1]]
    placed = xyz[on_it].astype(float) @ R.T + t
    errors = np.linalg.norm(placed - true_xyz[pixels[on_it, 0], pixels[on_it, 1]], axis=1)
    misfit = np.linalg.norm(found @ R.T + t - truth, axis=1)
    return TruthComparison(
        errors[np.isfinite(errors)], float(on_it.sum() / true_specimen.sum()), size - 1, float(np.median(misfit))
    )

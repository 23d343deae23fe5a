"""Runs that repeat stage 4 alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from specimap_core.truth.truth_file import save_truth
from specimap_validation.phantom import Phantom, PhantomSettings, write_cube
from specimap_validation.phantom.render import CLASS_CARD
from tests.support.scenes import Finished, OnDisk

COVER = 5000
"""What the cube shows of a covered card."""


def rerun(
    finished: Finished, small: OnDisk, folder: Path, settings: PhantomSettings, hidden: tuple[int, ...]
) -> Report:
    """The finished run's photos with another cube, some markers of it under a cover: what stage 4 makes of it."""
    phantom = Phantom(settings)
    truth = phantom.truth
    nearest = np.linalg.norm(truth.hsi_xyz[..., None, :] - truth.marker_corners.mean(1), axis=-1).argmin(-1)
    cube = phantom.cube()
    cube[np.isin(truth.marker_ids[nearest], hidden) & (truth.hsi_class == CLASS_CARD)] = COVER
    write_cube(cube, truth.wavelengths_nm, folder / "hsi" / "hsi.hdr", interleave="bsq")
    save_truth(truth, folder / "truth.npz")
    report = run_pipeline(
        Inputs(small.photos, folder / "hsi" / "hsi.hdr"), finished.copy_to(folder / "out"), PipelineSettings()
    )
    assert {"reconstruct", "adjust"} <= set(report.reused_stages)
    return report


def codes(report: Report) -> set[str]:
    return {warning.code for warning in report.warnings}

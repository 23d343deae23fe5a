"""Runs that repeat stage 4 alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from specimap_core.truth.truth_file import save_truth
from specimap_validation.phantom import Phantom, PhantomSettings, write_cube
from specimap_validation.phantom.render import CLASS_CARD
from tests.support.scenes import Finished, OnDisk
from tests.support.shared_folders import SharedFolders

COVER = 5000
"""What the cube shows of a covered card."""


@dataclass(frozen=True)
class Reruns:
    """Reruns of the ``finished`` run on the ``small`` phantom, each made once for all processes."""

    shared_folders: SharedFolders
    finished: Finished
    small: OnDisk

    def on(self, settings: PhantomSettings, hidden: tuple[int, ...] = ()) -> tuple[Path, Report]:
        """Folder with ``hsi``, ``truth.npz`` and ``out``, and the report: see :func:`rerun`. Nobody changes it."""
        folder = self.shared_folders.made(
            "rerun", (settings, hidden), lambda folder: rerun(self.finished, self.small, folder, settings, hidden)
        )
        return folder, Report.model_validate_json((folder / "out" / "report.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def reruns(shared_folders: SharedFolders, finished: Finished, small: OnDisk) -> Reruns:
    """The finished run's photos with other cubes."""
    return Reruns(shared_folders, finished, small)


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

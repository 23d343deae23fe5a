"""Run the pipeline and judge the result; the outcome is kept by studies and validations."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from specimap_core.atomic import remove
from specimap_core.errors import (
    CancelledError,
    DepthNotFoundError,
    DuplicateMarkersError,
    MarkerGeometryError,
    MarkersMissingInCubeError,
    NoMarkersFoundError,
    PhotosNotConnectedError,
    PhotoUnreadableError,
    RegistrationError,
    TooFewPhotosError,
)
from specimap_core.pipeline.clock import Progress
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.register.figures import Quartiles, Section, Spread
from specimap_core.report.model import Report
from specimap_core.truth.judge import judge_with_sigma
from specimap_core.verification.figures import Verdict

REFUSED = (
    TooFewPhotosError,
    PhotosNotConnectedError,
    DepthNotFoundError,
    NoMarkersFoundError,
    DuplicateMarkersError,
    MarkersMissingInCubeError,
    MarkerGeometryError,
    RegistrationError,
    PhotoUnreadableError,
)
"""Errors that concern photos or cube of one run; others (a full disk, a stop) end the whole study."""
STAGE_SHARES = {"reconstruct": 0.5, "adjust": 0.4, "render": 0.02, "register": 0.08}


class AgainstTruth(Section):
    """A run's specimen pixels against truth: error median and 95th percentile, mm; coverage 0..1; ``scale``: size of
    the result over the true one, less 1; shares of the errors within one and two stated standard deviations."""

    median_mm: float
    p95_mm: float
    coverage: float
    scale: float
    within_1_sigma: float
    within_2_sigma: float


class Certified(Section):
    """What a run's certificate says without any truth: its verdict, and the errors seen, mm, None where it saw none."""

    verdict: Verdict
    seen_median_mm: float | None
    seen_p95_mm: float | None

    @staticmethod
    def of(report: Report) -> Certified | None:
        """Of the report; None where it has no certificate."""
        found = report.certificate
        if found is None:
            return None
        total = found.total_mm
        return Certified(
            verdict=found.verdict,
            seen_median_mm=None if total is None else total.median,
            seen_p95_mm=None if total is None else total.p95,
        )


class Figures(Section):
    """Figures of a run's report, and its errors against truth where that is known; ``certified`` is None in outcomes of
    versions that made no certificate."""

    photos_given: int
    photos_used: int
    corner_2d_mm: Spread
    corner_3d_mm: Quartiles | None
    leave_one_marker_out_mm: float | None
    seconds: float
    warnings: list[str]
    truth: AgainstTruth | None
    certified: Certified | None = None


class Refusal(Section):
    """The reason why a run was refused."""

    code: str
    message: str


class Outcome(Section):
    """A run's figures, or the reason why there are none."""

    figures: Figures | None
    refusal: Refusal | None


def run_and_judge(
    inputs: Inputs,
    out: Path,
    settings: PipelineSettings,
    truth: Path | None,
    *,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> Outcome:
    """Run into ``out`` and judge against the truth in the folder ``truth``; a refusal is an outcome, too.

    Raises:
        SpecimapError: errors that do not concern the acquisition, ``CancelledError`` among them.
    """
    try:
        report = run_pipeline(inputs, out, settings, progress=_stage_progress(progress), cancelled=cancelled)
    except REFUSED as error:
        return Outcome(figures=None, refusal=Refusal(code=error.code, message=error.message))
    return Outcome(figures=figures_of(report, out, truth), refusal=None)


def figures_of(report: Report, out: Path, truth: Path | None) -> Figures:
    """Compute the figures of a finished run in ``out``."""
    left_out = report.leave_one_marker_out_mm
    return Figures(
        photos_given=report.photos.given,
        photos_used=len(report.photos.used),
        corner_2d_mm=report.corner_2d_mm,
        corner_3d_mm=report.corner_3d_mm if np.isfinite(report.corner_3d_mm.median) else None,
        leave_one_marker_out_mm=None if left_out is None else left_out.median,
        seconds=round(sum(report.seconds.values()), 2),
        warnings=[w.code for w in report.warnings],
        truth=None if truth is None else _judge_against(out, truth),
        certified=Certified.of(report),
    )


def _judge_against(out: Path, truth: Path) -> AgainstTruth:
    judged = judge_with_sigma(out, truth)
    errors = judged.errors
    return AgainstTruth(
        median_mm=errors.median,
        p95_mm=errors.p95,
        coverage=errors.coverage,
        scale=errors.scale,
        within_1_sigma=judged.within(1),
        within_2_sigma=judged.within(2),
    )


def _stage_progress(progress: Callable[[float], None]) -> Progress:
    """Turn progress of the whole run into progress of its stages."""
    names = list(STAGE_SHARES)

    def report_stage(stage: str, share: float) -> None:
        before = sum(STAGE_SHARES[name] for name in names[: names.index(stage)])
        progress(before + STAGE_SHARES[stage] * share)

    return report_stage


def stoppable(progress: Callable[[float], None], cancelled: Callable[[], bool]) -> Callable[[float], None]:
    """Wrap ``progress`` so that it raises CancelledError once a stop was requested."""

    def report_or_stop(share: float) -> None:
        if cancelled():
            raise CancelledError("Stopped.", advice="Run again to go on from the last finished run.")
        progress(share)

    return report_or_stop


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """Make a temporary folder, removed at the end; one that a killed run left is removed at the next start."""
    aside = folder / f".run.{uuid.uuid4().hex[:8]}.tmp"
    aside.mkdir()
    try:
        yield aside
    finally:
        remove(aside)

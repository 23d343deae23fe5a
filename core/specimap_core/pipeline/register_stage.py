"""Stage 4: register the cube, then write mesh, corners, cameras, cloud, preview and report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.atomic import write_text
from specimap_core.cloud import Cloud
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.write_summary import WriteSummary
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import Cube
from specimap_core.errors import MarkersMissingInCubeError
from specimap_core.json_text import json_text
from specimap_core.notices import Notices
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.pipeline.cameras import cameras_of
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.outputs import Outputs, staged
from specimap_core.pipeline.report_builder import RunRecord, build_report
from specimap_core.pipeline.run_warnings import with_assumptions
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.progress import within
from specimap_core.register.registration import Surface, register_cube
from specimap_core.report.model import Report
from specimap_core.report.quality_gates import gated
from specimap_core.surface.mesh_files import write_mesh_ply
from specimap_core.verification.certificate import Verification, verify

REGISTERED_SHARE, CHECKED_SHARE, CLOUD_SHARE = 0.35, 0.15, 0.4
"""Shares of the stage's progress: the registration, its check, and the writing of the cloud."""


@dataclass(frozen=True)
class CubeInput:
    """The ``cube`` of a run, ``warnings`` about the inputs, and their ``hashes`` with the result's key."""

    cube: Cube
    warnings: Notices
    hashes: Mapping[str, str]


def register_stage(
    stage1: Stage1,
    surface: Surface,
    given: CubeInput,
    settings: PipelineSettings,
    outputs: Outputs,
    clock: Clock,
) -> Report:
    """Stage 4; all results appear in ``outputs`` together, the report last."""
    cube = given.cube
    with clock.stage("register") as progress:
        try:
            registered = register_cube(
                cube,
                surface,
                settings.reconstruct.dictionary,
                settings.register,
                join=settings.adjust.form == "rigid",
                progress=lambda share: progress(REGISTERED_SHARE * share),
            )
        except MarkersMissingInCubeError as error:
            raise with_assumptions(error, cube.warnings) from error
        checked = REGISTERED_SHARE + CHECKED_SHARE
        names = [stage1.names[p] for p in stage1.reconstruction.photos]
        verification = verify(
            registered, stage1.greys, names, cube, settings.refine, within(progress, REGISTERED_SHARE, checked)
        )
        registered = replace(registered, points=verification.scaled(registered.points))
        adjusted = registered.surface.adjusted
        run = RunRecord(settings, given.hashes, clock.seconds, clock.reused, given.warnings)
        report = gated(build_report(stage1, adjusted, registered, run), settings.adjust.edge_mm)
        report = certified(report, verification)

        def attributes(written: WriteSummary) -> dict[str, object]:
            nonlocal report
            report = report.model_copy(update={"warnings": [*report.warnings, *written.warnings()]})
            return {"report": report.summary(), "settings": settings.as_dict(), "inputs": dict(given.hashes)}

        with staged(outputs) as aside:
            write_mesh_ply(aside.mesh, registered.surface.caster.mesh)
            named = zip(adjusted.marker_ids, adjusted.corners, strict=True)
            write_text(aside.corners, json_text({str(i): np.round(c, 6).tolist() for i, c in named}, indent=1))
            write_text(aside.cameras, cameras_of(stage1, adjusted, registered).text())
            write_cloud(
                aside.cloud,
                registered.points,
                cube,
                attributes,
                progress=lambda share: progress(checked + CLOUD_SHARE * share),
            )
            write_preview(Cloud.open(aside.cloud), aside.preview)
            if stage1.sheet:
                aside.sheet.write_bytes(stage1.sheet)
            report = report.model_copy(update={"seconds": clock.so_far()})
            write_text(aside.report, report.text())
    return report


def certified(report: Report, verification: Verification) -> Report:
    """The report with its certificate and the warnings that this calls for."""
    warnings = [*report.warnings, *verification.warnings()]
    certificate = verification.certificate({w.code for w in warnings})
    return report.model_copy(update={"warnings": warnings, "certificate": certificate})

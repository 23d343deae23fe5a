"""Validation: every defect, both registrations, both adjustments, each judged against truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from specimap_core import __version__
from specimap_core.atomic import write_text
from specimap_core.bundle_adjust.adjust import Form
from specimap_core.errors import OutputExistsError
from specimap_core.json_text import json_text
from specimap_core.pipeline.artefact_store import FORMAT
from specimap_core.pipeline.outputs import Inputs, prepare_folder
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.progress import within
from specimap_core.register.figures import Section
from specimap_core.register.settings import Method
from specimap_validation.capture import Capture, find_capture
from specimap_validation.cases import Case
from specimap_validation.phantom import load_truth, write_phantom
from specimap_validation.runs import Outcome, run_and_judge, scratch_in, stoppable

SCHEMA_VERSION = 1
FILE = "validation.json"
MARK = "validation"
"""Name of the marks in the documentation between which the tables are put."""
VARIANTS: tuple[tuple[Method, Form], ...] = (
    ("camera", "rigid"),
    ("homography", "rigid"),
    ("camera", "free"),
    ("homography", "free"),
)
"""Registration and adjustment. The order matters: two that share an adjustment share stages 1 to 3."""
DEFAULT, AS_PUBLISHED = VARIANTS[0], VARIANTS[3]
_PHANTOM_SHARE = 0.3
"""Share of a case's time that making its phantom takes."""


class Row(Section):
    """One run: its case and its variant. ``key``: a hash of the case, the program and its version."""

    defect: str
    seed: int | None
    method: Method
    adjustment: Form
    key: str
    outcome: Outcome


class Validation(Section):
    """A validation as it is stored."""

    schema_version: Literal[1] = 1
    specimap_version: str
    quick: bool
    rows: list[Row]
    """By case, in the order in which the defects are listed, then by variant."""


def validate(
    cases: Sequence[Case],
    out: Path,
    *,
    quick: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    on_row: Callable[[Row], None] = lambda row: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Validation:
    """Run each case by each variant; write the outcomes to ``out / "validation.json"`` after every case.

    Cases that an earlier, interrupted validation left there are not repeated. Phantoms and results are made in a
    temporary folder and removed as soon as they are judged. ``on_row`` is called with each new row, ``progress`` with
    the share of the whole validation, 0..1.

    Raises:
        OutputExistsError: ``out`` holds foreign files, or a validation of another version.
        SpecimapError: errors that concern the whole validation: the disk is full, a stop.
    """
    prepare_folder(out)
    target = out / FILE
    kept = {(row.key, row.method, row.adjustment): row for row in _read_earlier(target)}
    rows: list[Row] = []

    def keep() -> Validation:
        done = {(row.key, row.method, row.adjustment) for row in rows}
        # Earlier rows of cases that are still to run stay in the file, so that a stop loses none.
        waiting = [row for place, row in kept.items() if place not in done and row.key in keys]
        whole = Validation(specimap_version=__version__, quick=quick, rows=[*rows, *waiting])
        write_text(target, whole.model_dump_json(indent=1))
        return whole

    keys = [_key(case) for case in cases]
    for number, (case, key) in enumerate(zip(cases, keys, strict=True)):
        part = within(progress, number / len(cases), (number + 1) / len(cases))
        found = [kept.get((key, *variant)) for variant in VARIANTS]
        if all(row is not None for row in found):
            rows += [row for row in found if row is not None]
        else:
            fresh = _run_variants(case, key, out, part, cancelled)
            rows += fresh
            keep()
            for row in fresh:
                on_row(row)
        part(1.0)
    return keep()


def _run_variants(
    case: Case, key: str, out: Path, progress: Callable[[float], None], cancelled: Callable[[], bool]
) -> list[Row]:
    """Run the four variants into one folder, so that they share stages."""
    rows = []
    with scratch_in(out) as aside:
        capture = _capture(case, aside, stoppable(within(progress, 0, _PHANTOM_SHARE), cancelled))
        edge_mm = load_truth(capture.folder).edge_mm
        for number, (method, form) in enumerate(VARIANTS):
            start = PipelineSettings()
            settings = replace(
                start,
                adjust=replace(start.adjust, form=form, edge_mm=edge_mm),
                reconstruct=replace(start.reconstruct, edge_mm=edge_mm),
                register=replace(start.register, method=method),
            )
            share = (1 - _PHANTOM_SHARE) / len(VARIANTS)
            outcome = run_and_judge(
                Inputs(capture.photos[0].parent, capture.cube),
                aside / "out",
                settings,
                capture.folder,
                progress=within(progress, _PHANTOM_SHARE + number * share, _PHANTOM_SHARE + (number + 1) * share),
                cancelled=cancelled,
            )
            rows.append(
                Row(defect=case.defect, seed=case.seed, method=method, adjustment=form, key=key, outcome=outcome)
            )
    return rows


def _capture(case: Case, aside: Path, progress: Callable[[float], None]) -> Capture:
    if case.capture is not None:
        return case.capture
    assert case.settings is not None
    write_phantom(case.settings, aside / "phantom", progress=progress)
    return find_capture(aside / "phantom")


def _key(case: Case) -> str:
    parts: dict[str, object] = {"version": __version__, "format": FORMAT, "pipeline": PipelineSettings().as_dict()}
    if case.settings is not None:
        parts["phantom"] = asdict(case.settings)
    elif case.capture is not None:
        files = [*case.capture.photos, case.capture.cube, case.capture.folder / "truth.npz"]
        parts["files"] = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    return hashlib.sha256(json_text(parts, sort_keys=True).encode()).hexdigest()[:24]


def _read_earlier(target: Path) -> list[Row]:
    if not target.exists():
        return []
    try:
        return Validation.model_validate_json(target.read_text(encoding="utf-8")).rows
    except (OSError, ValidationError) as error:
        raise OutputExistsError(
            f"{target} is not a validation that this version of Specimap reads.", advice="Name another folder."
        ) from error

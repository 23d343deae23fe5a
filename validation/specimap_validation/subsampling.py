"""Subsampling study: the pipeline on random shares of an acquisition's photos, each run judged."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from specimap_core import __version__
from specimap_core.atomic import write_text
from specimap_core.cube import open_cube
from specimap_core.errors import OutputExistsError, SettingsError
from specimap_core.pipeline.keys import register_key, surface_keys
from specimap_core.pipeline.outputs import Inputs, prepare_folder
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.progress import within
from specimap_core.register.figures import Section
from specimap_validation.capture import Capture
from specimap_validation.photo_subsets import random_subset
from specimap_validation.runs import Outcome, run_and_judge, scratch_in

SCHEMA_VERSION = 1
SHARES = (100, 90, 80, 70, 60, 50)
SEEDS = 3
FILE = "subsampling.json"


class Row(Section):
    """One run: ``share`` of the photos in percent, the ``seed`` that chose them, their number ``photos``."""

    share: int
    seed: int
    photos: int
    outcome: Outcome


class Study(Section):
    """A subsampling study as it is stored. ``key``: a hash of photos, cube, settings and program."""

    schema_version: Literal[1] = 1
    specimap_version: str
    acquisition: str
    key: str
    photos: int
    has_truth: bool
    method: str
    adjustment: str
    rows: list[Row]
    """By falling share, then seed."""


def plan(shares: Sequence[int], seeds: int) -> list[tuple[int, int]]:
    """List (share, seed) of each run: all photos once, every other share with each seed.

    Raises:
        SettingsError: a share is not within 1 to 100 percent, or there is no seed.
    """
    if not shares or any(not 1 <= share <= 100 for share in shares):
        raise SettingsError("Shares lie within 1 and 100 percent.", advice="For example 100,80,60.", setting="shares")
    if seeds < 1:
        raise SettingsError(f"{seeds} seeds are no study.", advice="Give at least 1.", setting="seeds")
    ordered = sorted(set(shares), reverse=True)
    return [(share, seed) for share in ordered for seed in range(1, (1 if share == 100 else seeds) + 1)]


def study_subsampling(
    capture: Capture,
    out: Path,
    settings: PipelineSettings,
    *,
    shares: Sequence[int] = SHARES,
    seeds: int = SEEDS,
    progress: Callable[[float], None] = lambda share: None,
    on_row: Callable[[Row], None] = lambda row: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Study:
    """Run on each share and seed; write the outcomes to ``out / "subsampling.json"`` after every run.

    Runs that an earlier study of the same acquisition and settings left there are not repeated, and stay in the file.
    ``on_row`` is called with each new row, ``progress`` with the share of the whole study, 0..1.

    Raises:
        SettingsError: see :func:`plan`.
        OutputExistsError: ``out`` holds another study, or foreign files.
        SpecimapError: errors that concern the whole study: the cube does not open, the disk is full, a stop.
    """
    settings.check()
    runs = plan(shares, seeds)
    key = _key(capture, settings)
    prepare_folder(out)
    target = out / FILE
    rows = {(row.share, row.seed): row for row in _read_earlier(target, key)}

    def keep() -> Study:
        study = Study(
            specimap_version=__version__,
            acquisition=capture.name,
            key=key,
            photos=len(capture.photos),
            has_truth=capture.has_truth,
            method=settings.register.method,
            adjustment=settings.adjust.form,
            rows=[rows[place] for place in sorted(rows, key=lambda place: (-place[0], place[1]))],
        )
        write_text(target, study.model_dump_json(indent=1))
        return study

    for number, (share, seed) in enumerate(runs):
        whole = within(progress, number / len(runs), (number + 1) / len(runs))
        if (share, seed) not in rows:
            row = _run(capture, out, settings, share, seed, progress=whole, cancelled=cancelled)
            rows[share, seed] = row
            keep()
            on_row(row)
        whole(1.0)
    return keep()


def _run(
    capture: Capture,
    out: Path,
    settings: PipelineSettings,
    share: int,
    seed: int,
    *,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> Row:
    chosen = list(capture.photos) if share == 100 else random_subset(capture.photos, share / 100, seed)
    with scratch_in(out) as aside:
        photos = aside / "photos"
        photos.mkdir()
        for photo in chosen:
            (photos / photo.name).symlink_to(photo.resolve())
        outcome = run_and_judge(
            Inputs(photos, capture.cube),
            aside / "out",
            settings,
            capture.folder if capture.has_truth else None,
            progress=progress,
            cancelled=cancelled,
        )
    return Row(share=share, seed=seed, photos=len(chosen), outcome=outcome)


def _key(capture: Capture, settings: PipelineSettings) -> str:
    digests = {photo.name: hashlib.sha256(photo.read_bytes()).hexdigest() for photo in capture.photos}
    return register_key(surface_keys(digests, settings)["render"], open_cube(capture.cube).fingerprint(), settings)


def _read_earlier(target: Path, key: str) -> list[Row]:
    if not target.exists():
        return []
    try:
        study = Study.model_validate_json(target.read_text(encoding="utf-8"))
    except (OSError, ValidationError) as error:
        raise OutputExistsError(
            f"{target} is not a study that this version of Specimap reads.", advice="Name another folder."
        ) from error
    if study.key != key:
        raise OutputExistsError(
            f"{target} is the study of other photos, another cube, or other settings.", advice="Name another folder."
        )
    return study.rows

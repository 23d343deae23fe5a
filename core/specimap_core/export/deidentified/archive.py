"""The ZIP of a de-identified export."""

from __future__ import annotations

import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from specimap_core import __version__
from specimap_core.atomic import disk_errors
from specimap_core.export.archive import write_files_zip
from specimap_core.export.deidentified.cubes import clean_cube
from specimap_core.export.deidentified.photos import clean_photo
from specimap_core.export.deidentified.plan import Plan
from specimap_core.export.deidentified.results import clean_result
from specimap_core.json_text import json_text

ROLES = ("cube", "white", "dark")


def write_deidentified(source: Path, plan: Plan, target: Path) -> Path:
    """Write a ZIP with ``export.json``, ``result/`` and, where the plan says so, ``photos/`` and ``cube/``.

    Args:
        source: a folder with a result's files and, for the inputs, ``photos/`` and the folders of :data:`ROLES`.

    Raises:
        PhotoUnreadableError, CubeHeaderError, CloudDamagedError: a part does not read; there is no export then.
        StorageFullError, OutputNotWritableError.
    """
    with disk_errors(target), TemporaryDirectory(prefix=".", suffix=".tmp", dir=target.parent) as folder:
        made = Path(folder)
        clean_result(source, made / "result", {old: f"{new}.jpg" for old, new in plan.photos.items()})
        facts: dict[str, object] = {
            "specimap_version": __version__,
            "specimen": plan.specimen,
            "acquisition": plan.acquisition,
            "result": plan.result,
            "captured_shifted": plan.captured,
            "made_shifted": plan.made,
            "dictionary": plan.dictionary,
            "edge_mm": plan.edge_mm,
        }
        if plan.inputs:
            facts["photos"] = _photos(source / "photos", made / "photos", plan)
            for role in ROLES:
                _cube(source / role, made / "cube", role)
        (made / "export.json").write_text(json_text(facts, indent=1), encoding="utf-8")
        files = sorted(path for path in made.rglob("*") if path.is_file())
        named = ((path.relative_to(made).as_posix(), path) for path in files)
        return write_files_zip(target, named, {}, zipfile.ZIP_DEFLATED)


def _photos(source: Path, target: Path, plan: Plan) -> list[dict[str, object]]:
    target.mkdir()
    return [clean_photo(source / old, target / f"{new}.jpg") for old, new in sorted(plan.photos.items())]


def _cube(source: Path, target: Path, role: str) -> None:
    files = sorted(source.iterdir()) if source.is_dir() else []
    if files:
        target.mkdir(exist_ok=True)
        # An ENVI header stands for its data, too.
        clean_cube(next((path for path in files if path.suffix == ".hdr"), files[0]), target / f"{role}.hdr")

"""Cube files: which part of a cube one is, what its header says, and whether header and data make a usable cube."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.cube import FORMATS, Cube, inspect, open_cube
from specimap_core.cube.envi import EnviFormat
from specimap_core.cube.envi_header import EnviHeader, is_envi_header, read_header
from specimap_core.cube.npy import starts_with
from specimap_core.cube.pixels import sampled_rows
from specimap_core.cube.wavelengths import bad_band_mask, nanometres
from specimap_core.errors import CubeFormatError, CubeHeaderError, SpecimapError, StorageFullError
from specimap_core.notices import Notices
from specimap_core.screening.verdict import Verdict

Part = Literal["header", "data", "whole"]
AMBIGUOUS_SUFFIXES = frozenset({".hdf", ".btf"})
"""Ends of names that other files have too: such a file may be an ENVI cube's data."""
CLAIMED_WHOLE = (
    frozenset(suffix for known in FORMATS if known.name != EnviFormat.name for suffix in known.suffixes)
    - AMBIGUOUS_SUFFIXES
)
"""A file whose name ends so is a whole cube, or refused."""
ZIP_MAGIC = b"PK\x03\x04"
SAMPLED_ROWS = 48
MEAN_BANDS = 8
MOST_BANDS = 1_000_000


def judge_part(path: Path, claimed: str, expected_bytes: int | None) -> Verdict:
    """Find which part of a cube a file is, and judge a header. Facts: ``part`` (header, data, whole), ``suffix``.

    Args:
        path: the file; its name is not looked at.
        claimed: the suffix that it came with, lower case: a file that is not what it claims to be is refused.
        expected_bytes: of the data, where the header is known. A file of exactly this size is the data.
    """
    if expected_bytes is not None and path.stat().st_size == expected_bytes and claimed != ".hdr":
        return Verdict(facts={"part": "data", "suffix": ".raw"})
    if claimed == ".hdr" or is_envi_header(path):
        facts: dict[str, Any] = {"part": "header", "suffix": ".hdr"}
        try:
            return Verdict(facts=facts | _header_facts(read_header(path)))
        except SpecimapError as error:
            return _refused(error, path, facts)
    for known in FORMATS:
        if known.stored_suffix is not None and known.matches(path):
            return Verdict(facts={"part": "whole", "suffix": known.stored_suffix})
    if starts_with(path, ZIP_MAGIC) and claimed == ".npz":
        return Verdict(facts={"part": "whole", "suffix": ".npz"})
    if claimed in CLAIMED_WHOLE:
        return Verdict(
            "refused",
            CubeFormatError.code,
            f"It is no {claimed} file, though its name says so.",
            "Copy or export the cube again.",
            {"part": "whole", "suffix": ".bin"},
        )
    return Verdict(facts={"part": "data", "suffix": ".raw"})


def judge_cube(path: Path) -> Verdict:
    """Open a whole cube (for ENVI the header, with its data in the same folder) and look at some rows.

    Facts: rows, cols, bands, dtype, quantity, ``wavelength_nm`` (shortest, longest), warnings.
    """
    try:
        _check_no_links(path.parent)
        cube = open_cube(path)
        warnings = cube.warnings + inspect(cube, _sampled_mean(cube))
    except StorageFullError:
        reason, advice = "There is no room to unpack it here; the job will tell.", "Give the cube uncompressed."
        return Verdict("doubtful", "cube_not_examined", reason, advice)
    except SpecimapError as error:
        return _refused(error, path, {})
    except Exception as error:
        # What a library raises while values are read from a damaged file.
        reason = f"Its values do not read ({type(error).__name__})."
        return Verdict("refused", CubeFormatError.code, reason, "Copy or export the cube again.")
    facts = {
        "rows": cube.rows,
        "cols": cube.cols,
        "bands": cube.bands,
        "dtype": str(cube.dtype),
        "quantity": cube.quantity,
        "wavelength_nm": _range(cube.wavelengths_nm),
        "warnings": _listed(warnings),
    }
    return Verdict(facts=facts)


def _check_no_links(folder: Path) -> None:
    """Raises CubeFormatError for a link among the files, which lie alone in their folder: none was uploaded."""
    if any(file.is_symlink() for file in folder.iterdir()):
        raise CubeFormatError("One of the cube's files is a link to another file.", advice="Upload the file itself.")


def _sampled_mean(cube: Cube) -> NDArray[np.float32]:
    """Mean of a few bands, of a few rows: enough to see that there is nothing."""
    good = np.flatnonzero(~cube.bad_bands)
    chosen = good[np.unique(np.linspace(0, len(good) - 1, MEAN_BANDS).astype(int))]
    rows = []
    for row in sampled_rows(cube.rows, SAMPLED_ROWS):
        values = cube.read_rows(row, row + 1)[0][:, chosen].astype(np.float32)
        known = np.isfinite(values)
        count = known.sum(1)
        rows.append(np.where(count > 0, np.where(known, values, 0).sum(1) / np.maximum(count, 1), np.nan))
    return np.stack(rows).astype(np.float32)


def _header_facts(header: EnviHeader) -> dict[str, Any]:
    if header.bands > MOST_BANDS:
        raise CubeHeaderError(
            f"The header says {header.bands} bands, more than any camera has.",
            advice="Correct 'bands' in the header, or export the cube again.",
            field="bands",
        )
    wavelengths, about = nanometres(header.wavelengths, header.wavelength_units, header.bands)
    _, about_bands = bad_band_mask(header.bad_band_list, header.bands)
    return {
        "rows": header.rows,
        "cols": header.cols,
        "bands": header.bands,
        "interleave": header.interleave,
        "dtype": str(header.dtype),
        "expected_bytes": None if header.compressed else header.data_bytes,
        "wavelength_nm": _range(wavelengths),
        "warnings": _listed(header.warnings + about + about_bands),
    }


def _range(wavelengths: Floats) -> list[float] | None:
    known = wavelengths[np.isfinite(wavelengths)]
    return [round(float(known.min()), 3), round(float(known.max()), 3)] if known.size else None


def _listed(warnings: Notices) -> list[dict[str, str]]:
    return [{"code": warning.code, "text": warning.message} for warning in warnings]


def _refused(error: SpecimapError, path: Path, facts: dict[str, Any]) -> Verdict:
    facts = {**facts, **{k: v for k, v in error.details.items() if k in ("field", "expected_bytes", "found_bytes")}}
    subject = "header" if isinstance(error, CubeHeaderError) and is_envi_header(path) else "cube"
    # Its name here is none that the sender gave.
    named = re.escape(str(path)) + "|" + re.escape(path.name)
    reason = re.sub(named, lambda at: f"{'the' if at.start() else 'The'} {subject}", error.message)
    return Verdict("refused", error.code, reason, error.advice, facts)

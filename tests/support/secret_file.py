"""A file that no cube may show, and a search for it in all that a cube says."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from specimap_core.cube import Cube, inspect, open_cube
from specimap_core.errors import SpecimapError
from specimap_core.screening.cube import judge_cube, judge_part
from tests.support.cube_files import random_values

SHAPE = (7, 5, 11)
VALUES = random_values("u1", SHAPE)
NM = np.linspace(400, 1000, 11)
# As reflectance would be, so that no check of values hides it; its bytes occur nowhere else.
SECRET = np.random.default_rng(99).uniform(400, 900, 400)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A folder next to the cube's with a file that no cube may show, as raw numbers, as HDF5 and as TIFF."""
    folder = tmp_path / "secret"
    folder.mkdir()
    (folder / "raw").write_bytes(SECRET.tobytes())
    with h5py.File(folder / "other.h5", "w") as f:
        f["cube"] = np.resize(SECRET, SHAPE)
        f["vector"] = np.resize(SECRET, 11)
        f["text"] = "nm of the secret"
    tifffile.imwrite(folder / "other.tif", np.resize(SECRET, SHAPE), photometric="minisblack")
    return folder


def check_nothing_leaks(path: Path, **references: Path) -> SpecimapError | None:
    """Open, read and judge ``path`` all through; return the refusal. No byte of the secret is in any of it."""
    seen: list[Any] = []
    refusal: SpecimapError | None = None
    try:
        cube = open_cube(path, **references)
        seen += [*_all_of(cube), *inspect(cube, cube.mean_image())]
    except SpecimapError as error:
        refusal = error
        seen += ["".join(traceback.format_exception(error)), error.as_dict()]
    if not references:
        seen += [judge_part(path, path.suffix, None).as_dict(), judge_cube(path).as_dict()]
    words = " ".join(x if isinstance(x, str) else repr(x) for x in seen if not isinstance(x, np.ndarray))
    numbers = [np.asarray(x, np.float64).ravel() for x in seen if isinstance(x, np.ndarray)]
    for value in SECRET:
        assert repr(float(value))[:9] not in words
        assert not any(np.isclose(x, value, rtol=1e-6, atol=0).any() for x in numbers)
    assert "of the secret" not in words
    return refusal


def _all_of(cube: Cube) -> list[Any]:
    return [
        cube.read_rows(0, cube.rows),
        cube.wavelengths_nm,
        cube.bad_bands,
        cube.mean_image(),
        cube.warnings,
        repr(cube),
        cube.quantity,
        cube.fingerprint(),
    ]

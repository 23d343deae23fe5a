"""Inputs of a document: the files of a finished run, and truth where there is some."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from specimap_core.arrays import Bytes
from specimap_core.cloud import Cloud
from specimap_core.errors import PhotoUnreadableError
from specimap_core.photos.contact_sheet import read_tiles
from specimap_core.report.maps import CubeFrame, TopRaster, cube_frame, top_raster
from specimap_core.report.model import Report, read_report

if TYPE_CHECKING:
    from specimap_core.truth.judge import Judged


@dataclass(frozen=True, eq=False)
class Material:
    """``shape``: rows and columns of the cube; ``tiles``: of the used photos, or none; ``preview``: RGBA (H, W, 4)."""

    report: Report
    cloud: Cloud
    shape: tuple[int, int]
    tiles: tuple[Bytes, ...]
    preview: Bytes | None
    errors: Judged | None

    @cached_property
    def frame(self) -> CubeFrame:
        """The cube's own view, for maps."""
        return cube_frame(self.cloud, self.shape)

    @cached_property
    def above(self) -> TopRaster:
        """The topmost surface."""
        return top_raster(self.cloud)


def read_material(folder: Path, truth: Path | None = None) -> Material:
    """Read what a run left in ``folder``: report.json and cloud.zarr, and photos.jpg and preview.png where they are.

    ``truth``: a phantom's ``truth.npz``, or its folder; corners.json is needed then.

    Raises:
        NotFoundError: there is no report, or none that this version reads, or no cloud, or no truth.
        SettingsError: the truth is of another acquisition.
        CloudDamagedError: the cloud does not read.
    """
    report, cloud = read_report(folder), Cloud.open(folder / "cloud.zarr")
    if report.cube_corners is not None:
        shape = report.cube_corners.rows, report.cube_corners.cols
    else:
        shape = (int(cloud.hsi_pixel[:, 0].max()) + 1, int(cloud.hsi_pixel[:, 1].max()) + 1)
    errors = None
    if truth is not None:
        from specimap_core.truth.judge import judge_with_sigma

        errors = judge_with_sigma(folder, truth)
    return Material(report, cloud, shape, _tiles(folder, report), _preview(folder), errors)


def _tiles(folder: Path, report: Report) -> tuple[Bytes, ...]:
    """None where the sheet is missing or of other photos: the document is then drawn without."""
    path, photos = folder / "photos.jpg", report.photo_corners
    if not photos or not path.is_file():
        return ()
    try:
        return tuple(read_tiles(path.read_bytes(), len(photos), photos[0].width_px, photos[0].height_px))
    except PhotoUnreadableError:
        return ()


def _preview(folder: Path) -> Bytes | None:
    import cv2

    path = folder / "preview.png"
    if not path.is_file():
        return None
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3 or image.shape[2] != 4:
        return None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA), np.uint8)

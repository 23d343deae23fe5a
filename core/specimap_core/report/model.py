"""The report of a run: JSON first; tables and pages are drawn from it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_ready, json_text
from specimap_core.notices import Notice
from specimap_core.register.figures import Figure, LeaveOneOut, MethodFigures, Quartiles, Section, Spread
from specimap_core.verification.figures import Certificate


class EdgeLength(Section):
    """Edges of the triangulated markers against the known edge, mm."""

    expected: Figure
    mean: Figure
    std: Figure
    n: int


class Refused(Section):
    """A photo that was not used."""

    name: str
    code: str
    reason: str


class Photos(Section):
    """Photos given, used and refused."""

    given: int
    used: list[str]
    refused: list[Refused]


class Inliers(Section):
    """Corners that the homography's RANSAC kept, and its threshold on the coarse grid and in mm."""

    n: int
    of: int
    threshold_px: Figure
    threshold_mm: Figure


class Reprojection(Section):
    """RMS corner distance in the photos, pixels, before and after stage 2."""

    before: Figure
    after: Figure


class CubeCameraFigures(Section):
    """The solved camera of the cube."""

    focal_px: Figure
    focal_relative_sd: Figure
    distance_mm: Figure
    reprojection_rms_px: Figure
    roll_deg: Figure
    mirrored: bool
    markers_found_in: str
    model: Literal["frame", "scan_rows", "scan_columns"] = "frame"
    """A frame camera, or a push-broom that recorded the cube row by row or column by column."""
    pixel_aspect: Figure = 1.0
    """Height of a pixel over its width."""


class Parallax(Section):
    """Distance between where the two methods put a pixel of the specimen, mm."""

    median: Figure
    maximum: Figure


class SigmaFigures(Section):
    """Stated standard deviation of the specimen's points, mm."""

    median: Figure
    p95: Figure


class Coverage(Section):
    """Share of the cube's pixels between the markers that have a point; counts of points."""

    between_markers: Figure
    points: int
    specimen_points: int


Corners = Annotated[list[list[Figure]], Field(description="x, y of four corners a marker: eight numbers.")]


class PhotoCorners(Section):
    """Marker corners in a used photo, upright and at working size, pixel centres at integers; to 0.1 px.

    ``residuals_px``: the adjusted corners, projected, less the measured ones; to 0.01 px.
    """

    name: str
    width_px: int
    height_px: int
    marker_ids: list[int]
    corners_px: Corners
    residuals_px: Corners


class CubeCorners(Section):
    """Marker corners in the cube as it is stored, x along its columns, to 0.1 px; residuals of its solved camera, to
    0.01 px."""

    rows: int
    cols: int
    marker_ids: list[int]
    corners_px: Corners
    residuals_px: Corners


class Report(Section):
    """All figures and warnings of a result. Lengths in mm, angles in degrees, times in seconds."""

    specimap_version: str
    created: str
    method: str
    backend: str
    adjustment: str
    marker_ids: list[int]
    marker_ids_in_cube: list[int]
    corner_2d_mm: Spread
    corner_3d_mm: Quartiles
    leave_one_marker_out_mm: LeaveOneOut | None
    methods: dict[str, MethodFigures]
    edge_length_mm: EdgeLength
    corner_sigma_mm: Figure
    reprojection_px: Reprojection
    photos: Photos
    inliers: Inliers
    coverage: Coverage
    parallax_removed_mm: Parallax
    sigma_mm: SigmaFigures
    cube_camera: CubeCameraFigures
    photo_focal_px: Figure
    seconds: dict[str, Figure]
    reused_stages: list[str]
    warnings: list[Notice]
    settings: dict[str, object] = Field(default_factory=dict)
    inputs: dict[str, str] = Field(default_factory=dict)
    photo_corners: list[PhotoCorners] | None = None
    """Of each used photo, in the order of ``photos.used``; None in reports of versions that did not keep them."""
    cube_corners: CubeCorners | None = None
    certificate: Certificate | None = None
    """Check against evidence that was not used; None in reports of versions that made none."""

    def summary(self) -> dict[str, object]:
        """As JSON values, without what report.json alone holds: readers of a cloud fetch its attributes first."""
        ready: dict[str, object] = json_ready(self.model_dump(mode="json", exclude=_DETAILS))
        return ready

    def text(self) -> str:
        """The report as JSON for people and programs: a line a field, but a line a photo for the corners."""
        head = json_text(self.summary(), indent=1, ensure_ascii=False)
        if self.photo_corners is None:
            return head
        photos = ",\n".join(f"  {_compact(photo)}" for photo in self.photo_corners)
        cube = "null" if self.cube_corners is None else _compact(self.cube_corners)
        corners = f'"photo_corners": [\n{photos}\n ],\n "cube_corners": {cube}'
        return f"{head.rstrip().removesuffix('}').rstrip()},\n {corners}\n}}"


_DETAILS = {"photo_corners", "cube_corners"}


def _compact(section: Section) -> str:
    return json_text(section.model_dump(mode="json"), separators=(",", ":"), ensure_ascii=False)


def read_report(folder: Path) -> Report:
    """The report of the finished run in ``folder``.

    Raises:
        NotFoundError: there is none that this version reads.
    """
    path = folder / "report.json"
    if not path.is_file():
        raise NotFoundError(f"{folder} holds no report.", advice="Name the folder of a finished run.")
    try:
        return Report.model_validate_json(path.read_text(encoding="utf-8", errors="replace"))
    except ValueError as error:
        raise NotFoundError(
            f"{path} is not a report that this version of Specimap reads.", advice="Repeat the run."
        ) from error

"""The report of a run: JSON first; tables and pages are drawn from it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """A part of the report; unknown fields are an error, so that a misspelt one does not get lost."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Spread(Section):
    """Mean and standard deviation of ``n`` values, mm."""

    mean: float
    std: float
    n: int


class Quartiles(Section):
    """Median and quartiles of ``n`` values, mm."""

    median: float
    q1: float
    q3: float
    n: int


class EdgeLength(Section):
    """Edges of the triangulated markers against the known edge, mm."""

    expected: float
    mean: float
    std: float
    n: int


class LeaveOneOut(Section):
    """Errors at a marker that took no part in the registration, mm. None where too few markers are left."""

    median: float
    maximum: float
    per_marker: dict[str, float]


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
    threshold_px: float
    threshold_mm: float


class Reprojection(Section):
    """RMS corner distance in the photos, pixels, before and after stage 2."""

    before: float
    after: float


class MethodFigures(Section):
    """Accuracy of one registration method at the markers."""

    corner_2d_mm: Spread
    corner_3d_mm: Quartiles
    leave_one_marker_out_mm: LeaveOneOut | None


class CubeCameraFigures(Section):
    """The solved camera of the cube."""

    focal_px: float
    focal_relative_sd: float
    distance_mm: float
    reprojection_rms_px: float
    roll_deg: float
    mirrored: bool
    markers_found_in: str


class Parallax(Section):
    """Distance between where the two methods put a pixel of the specimen, mm."""

    median: float
    maximum: float


class SigmaFigures(Section):
    """Stated standard deviation of the specimen's points, mm."""

    median: float
    p95: float


class Remark(Section):
    """Something that a reader of the result should know."""

    code: str
    message: str


class Coverage(Section):
    """Share of the cube's pixels between the markers that have a point; counts of points."""

    between_markers: float
    points: int
    specimen_points: int


class Report(Section):
    """Everything that is said about a result. Lengths in mm, angles in degrees, times in seconds."""

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
    corner_sigma_mm: float
    reprojection_px: Reprojection
    photos: Photos
    inliers: Inliers
    coverage: Coverage
    parallax_removed_mm: Parallax
    sigma_mm: SigmaFigures
    cube_camera: CubeCameraFigures
    photo_focal_px: float
    seconds: dict[str, float]
    reused_stages: list[str]
    warnings: list[Remark]
    settings: dict[str, object] = Field(default_factory=dict)
    inputs: dict[str, str] = Field(default_factory=dict)

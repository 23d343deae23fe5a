"""The report of a job: what docs/accuracy.md explains, as dataclasses; ``raw`` is the JSON object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from specimap_client._decode import Model


@dataclass(frozen=True, kw_only=True)
class Spread(Model):
    """Mean and standard deviation of ``n`` values, mm."""

    mean: float
    std: float
    n: int


@dataclass(frozen=True, kw_only=True)
class Quartiles(Model):
    """Median and quartiles of ``n`` values, mm."""

    median: float
    q1: float
    q3: float
    n: int


@dataclass(frozen=True, kw_only=True)
class EdgeLength(Model):
    """Edges of the triangulated markers against the known edge, mm."""

    expected: float
    mean: float
    std: float
    n: int


@dataclass(frozen=True, kw_only=True)
class LeaveOneOut(Model):
    """Errors at a marker that took no part in the registration, mm."""

    median: float
    maximum: float
    per_marker: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class RefusedPhoto(Model):
    """A photo that was not used."""

    name: str
    code: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Photos(Model):
    """Photos given, used and refused."""

    given: int
    used: tuple[str, ...]
    refused: tuple[RefusedPhoto, ...]


@dataclass(frozen=True, kw_only=True)
class Notice(Model):
    """Something that a reader of the result should know."""

    code: str
    message: str


@dataclass(frozen=True, kw_only=True)
class Coverage(Model):
    """Share of the cube's pixels between the markers that have a point; counts of points."""

    between_markers: float
    points: int
    specimen_points: int


@dataclass(frozen=True, kw_only=True)
class Report(Model):
    """What is said about a result; the sections that stand here only in ``raw`` are for experts. Lengths in mm."""

    specimap_version: str
    created: str
    method: str
    backend: str
    adjustment: str
    marker_ids: tuple[int, ...]
    marker_ids_in_cube: tuple[int, ...]
    corner_2d_mm: Spread
    corner_3d_mm: Quartiles
    leave_one_marker_out_mm: LeaveOneOut | None = None
    edge_length_mm: EdgeLength
    photos: Photos
    coverage: Coverage
    seconds: dict[str, float]
    warnings: tuple[Notice, ...]

    def __getitem__(self, section: str) -> Any:
        """A section as plain JSON values."""
        return self.raw[section]

"""Figures of a registration's accuracy, as the report and its JSON hold them. Light: the service imports it."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict

# JSON has no NaN: a figure that could not be had is null there.
Figure = Annotated[float, BeforeValidator(lambda value: float("nan") if value is None else value)]


class Section(BaseModel):
    """A part of the report; unknown fields are an error, so that a misspelt one does not get lost."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Spread(Section):
    """Mean and standard deviation of ``n`` values, mm."""

    mean: Figure
    std: Figure
    n: int


class Quartiles(Section):
    """Median and quartiles of ``n`` values, mm; NaN where ``n`` is 0."""

    median: Figure
    q1: Figure
    q3: Figure
    n: int


class LeaveOneOut(Section):
    """Errors at a marker that took no part in the registration, mm. None where too few markers are left."""

    median: Figure
    maximum: Figure
    per_marker: dict[str, Figure]


class MethodFigures(Section):
    """Accuracy of one registration method at the markers."""

    corner_2d_mm: Spread
    corner_3d_mm: Quartiles
    leave_one_marker_out_mm: LeaveOneOut | None

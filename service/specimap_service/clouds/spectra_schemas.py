"""Requests for spectra, and their answers."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

MOST_POINTS = 100_000
"""Points of one page."""
MOST_JSON_POINTS = 10_000
PAGE, JSON_PAGE = 10_000, 2_000
"""Points of a page where the request gives no limit."""
MOST_VERTICES = 10_000
FieldName = Literal["xyz", "normal", "rgb", "hsi_pixel", "sigma_mm", "flags", "distance_mm"]
Place = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Pixel = Annotated[int, Field(ge=0, le=65535)]
_Coordinate = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
_Number = Annotated[int, Field(ge=0, lt=2**32)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


def _say_one_of(schema: dict[str, Any]) -> None:
    """Say in a schema that exactly one of its properties is there and not null."""
    schema["oneOf"] = [
        {"required": [name], "properties": {name: {"not": {"type": "null"}}}} for name in schema["properties"]
    ]


class _OneOf(_Strict):
    model_config = ConfigDict(extra="forbid", json_schema_extra=_say_one_of)

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            names = ", ".join(type(self).model_fields)
            raise ValueError(f"give exactly one of {names}; this gives {', '.join(given) or 'none'}")
        return self


class Nearest(_Strict):
    """The ``k`` points nearest to a place, nearest first."""

    xyz: Place = Field(description="mm, marker frame.")
    k: int = Field(default=1, ge=1, le=MOST_POINTS)


class Box(_Strict):
    """All points in a box, borders included."""

    low: Place = Field(description="mm, marker frame.")
    high: Place

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError("low is at most high on each axis")
        return self


class Radius(_Strict):
    """All points at most this far from a place."""

    centre: Place = Field(description="mm, marker frame.")
    radius_mm: float = Field(ge=0, allow_inf_nan=False)


class Select(_OneOf):
    """A selection of points: exactly one of these."""

    indices: list[_Number] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_POINTS,
        fail_fast=True,
        description="Points by number, in this order.",
    )
    pixels: list[tuple[_Pixel, _Pixel]] | None = Field(
        default=None,
        min_length=1,
        max_length=MOST_POINTS,
        fail_fast=True,
        description="Points by row and column of the cube, in this order; a pixel without a point is left out.",
    )
    polygon: list[tuple[_Coordinate, _Coordinate]] | None = Field(
        default=None,
        min_length=3,
        max_length=MOST_VERTICES,
        fail_fast=True,
        description="Points whose pixel's centre lies in the closed polygon of (row, column); even-odd rule.",
    )
    nearest: Nearest | None = None
    box: Box | None = None
    radius: Radius | None = None


class Bands(_OneOf):
    """A selection of bands: exactly one of these."""

    nm: tuple[FiniteFloat, FiniteFloat] | None = Field(
        default=None, description="Bands from the first to the second wavelength, both included."
    )
    indices: list[_Number] | None = Field(
        default=None,
        min_length=1,
        max_length=65536,
        fail_fast=True,
        description="Bands by number, in this order, each once.",
        json_schema_extra={"uniqueItems": True},
    )

    @model_validator(mode="after")
    def _once(self) -> Self:
        if self.indices is not None and len(set(self.indices)) < len(self.indices):
            raise ValueError("indices names a band twice; give each once")
        return self


class SpectraRequest(_Strict):
    """Points, bands, and further columns of the points."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "select": {"radius": {"centre": [2.0, -3.0, 7.0], "radius_mm": 6}},
                "bands": {"nm": [500, 700]},
                "fields": ["xyz", "distance_mm"],
            }
        },
    )

    select: Select
    bands: Bands | None = Field(default=None, description="All bands where absent.")
    fields: list[FieldName] = Field(
        default_factory=list,
        max_length=7,
        description="Columns in addition to index and spectrum; `distance_mm` goes with `nearest` and `radius`.",
    )
    limit: int | None = Field(
        default=None,
        ge=1,
        le=MOST_POINTS,
        description=f"Most points; {PAGE} where absent, in JSON {JSON_PAGE} and never more than {MOST_JSON_POINTS}.",
    )
    offset: int = Field(default=0, ge=0, le=2**32, description="Points of the selection to skip at its start.")

    @model_validator(mode="after")
    def _has_centre(self) -> Self:
        if "distance_mm" in self.fields and self.select.nearest is None and self.select.radius is None:
            raise ValueError("distance_mm goes with the selections nearest and radius")
        return self


class SpectraAnswer(BaseModel):
    """One page of a selection. ``indices``, ``spectra`` and ``fields`` have one entry for each point."""

    model_config = ConfigDict(title="Spectra")

    total: int = Field(description="Points of the whole selection.")
    offset: int
    next_offset: int | None = Field(description="`offset` of the next page; null on the last one.")
    quantity: str = Field(description="Quantity of the values: `reflectance`, or `counts`.")
    bands: list[int]
    wavelength_nm: list[float | None]
    indices: list[int]
    spectra: list[list[float | None]] = Field(description="Null where a point has no value; NaN in Arrow and NumPy.")
    fields: dict[str, list[float | int | list[float | int] | None]]


class Point(BaseModel):
    """All values of one point."""

    index: int
    xyz: list[float] = Field(description="mm, marker frame.")
    normal: list[float]
    rgb: list[int]
    hsi_pixel: list[int] = Field(description="Row, column in the cube.")
    sigma_mm: float | None = Field(description="One standard deviation of the position.")
    flags: int
    flag_names: list[str]
    labels: dict[str, float | int | list[float | None] | None] = Field(description="Value of each label at this point.")
    quantity: str = Field(description="Quantity of the spectrum: `reflectance`, or `counts`.")
    bands: list[int]
    wavelength_nm: list[float | None]
    spectrum: list[float | None] = Field(description="Null where it has no value.")


class BandAnswer(BaseModel):
    """One band of all points, in their order."""

    model_config = ConfigDict(title="Band")

    band: int
    wavelength_nm: float | None
    quantity: str
    values: list[float | None] = Field(description="Null where a point has no value; NaN in Arrow and NumPy.")

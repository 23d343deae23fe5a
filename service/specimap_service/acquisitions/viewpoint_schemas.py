"""Where photos were taken from, as the API shows it."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Azimuth = Annotated[float, Field(description="Degrees about the markers' centre, from x toward y, -180 to 180.")]
Elevation = Annotated[float, Field(description="Degrees above the plane of the markers.")]


class PhotoViewpoint(BaseModel):
    """Where a photo was taken from."""

    file_id: str
    label: str
    azimuth_deg: Azimuth
    elevation_deg: Elevation
    distance_mm: float = Field(description="From the markers' centre.")


class UnplacedPhoto(BaseModel):
    """An accepted photo that does not tell where it was taken from."""

    file_id: str
    label: str
    markers: int = Field(description="How many markers read in it; with two or more they lie elsewhere than in others.")


class MarkerPlace(BaseModel):
    """A marker, as the photos place it."""

    id: int
    corners_mm: Annotated[list[tuple[float, float]], Field(min_length=4, max_length=4)] = Field(
        description="x, y of its corners, in the marker frame."
    )


class DomeCell(BaseModel):
    """A part of the dome of viewpoints."""

    model_config = ConfigDict(from_attributes=True)

    azimuth_deg: Azimuth
    elevation_deg: Elevation
    azimuth_from_deg: float
    azimuth_to_deg: float
    elevation_from_deg: float
    elevation_to_deg: float
    covered: bool = Field(description="Whether an accepted photo without faults was taken from there, or nearly so.")
    gap_deg: float | None = Field(description="From its middle to the nearest such photo; null without any.")


class Viewpoints(BaseModel):
    """The dome of viewpoints around a specimen, in the marker frame: z up, x toward the marker of the lowest id."""

    photos: list[PhotoViewpoint] = Field(description="In the order of their arrival.")
    unplaced: list[UnplacedPhoto]
    markers: list[MarkerPlace]
    cells: list[DomeCell]
    covered: float = Field(description="Share of the cells that are covered, 0 to 1.")
    next: DomeCell | None = Field(description="Where to stand next: near the newest photo; null where nothing is left.")
    enough: bool = Field(description="Whether the photos will do: 20 over nine tenths of the cells, or all cells.")

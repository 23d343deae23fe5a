"""The cameras of a result: what each photo and the cube were taken with, and from where. JSON first, as the report."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from specimap_core.json_text import json_text
from specimap_core.register.figures import Section

Matrix = list[list[float]]
"""``cam_from_world`` (3, 4): a rotation, and a translation in mm."""


class Camera(Section):
    """A lens, in pixels whose centres have integer coordinates."""

    model: Literal["pinhole", "push_broom"] = Field(
        description="`pinhole`: x, y in the camera's frame over z, times 1 + k1 r^2 + k2 r^4, times `focal_px`, plus "
        "`principal_point_px`. `push_broom`: see `scan`."
    )
    focal_px: list[float] = Field(description="In x and y.")
    principal_point_px: list[float]
    distortion: list[float] = Field(description="Radial terms k1, k2, as OpenCV's.")


class Scan(Section):
    """How a push-broom camera moves: 1 mm of the scan moves it ``skew`` mm along its line, and ``climb`` mm along z."""

    along: Literal["rows", "columns"] = Field(description="What the cube has one of for each line of the scan.")
    skew: float
    climb: float
    depth_mm: float = Field(description="A line is as far from the next as `focal_px` says at this depth.")


class PhotoCamera(Section):
    """The camera of a photo, for the photo as it was used: upright, and at most 1280 pixels long."""

    name: str = Field(description="The photo's label, as in the report.")
    width: int
    height: int
    cam_from_world: Matrix = Field(description="3 x 4: marker frame, mm, to the camera: x right, y down, z forward.")
    camera: Camera
    residual_px: float | None = Field(description="RMS distance of the markers' corners; null where it shows none.")


class CubeCamera(Section):
    """The camera of the cube, for the image that ``mirrored`` says."""

    width: int
    height: int
    cam_from_world: Matrix = Field(description="As of a photo; of a push-broom camera, at the middle of the scan.")
    camera: Camera
    scan: Scan | None = Field(description="Of a push-broom camera.")
    mirrored: bool = Field(description="The cube is stored mirrored: its column c is the camera's width - 1 - c.")
    residual_px: float = Field(description="RMS distance of the markers' corners.")


class Cameras(Section):
    """The cameras of a result, in the marker frame."""

    frame: Literal["marker"] = "marker"
    units: Literal["mm"] = "mm"
    photos: list[PhotoCamera] = Field(description="Of the photos used, in the report's order.")
    cube: CubeCamera

    def text(self) -> str:
        """The cameras as JSON, a line each."""
        photos = ",\n".join(f"  {_line(photo)}" for photo in self.photos)
        return (
            f'{{\n "frame": "{self.frame}",\n "units": "{self.units}",\n "photos": [\n{photos}\n ],\n'
            f' "cube": {_line(self.cube)}\n}}\n'
        )


def _line(section: Section) -> str:
    return json_text(section.model_dump(mode="json"), separators=(", ", ": "), ensure_ascii=False)

"""Files as the API shows them."""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from typing import Annotated, Literal

from fastapi import Path
from pydantic import BaseModel, ConfigDict, Field

from specimap_infra.completeness import DATA, HEADER, FileRow

Role = Literal["photo", "cube", "white", "dark"]
VerdictName = Literal["accepted", "doubtful", "refused"]
FileId = Annotated[str, Path(pattern=r"^file_[0-9a-z]{26}$", examples=["file_01k0000000000000000000000"])]


class CubeNotice(BaseModel):
    """Something about a cube that does not keep it from being used."""

    code: str
    text: str


class Judged(BaseModel):
    """The fields of every judgement."""

    verdict: VerdictName = Field(description="`doubtful`: usable, but better retaken. `refused`: no job uses the file.")
    code: str | None = Field(description="Stable code; docs/errors.md lists all. Null where there is nothing to say.")
    reason: str = Field(description="What is wrong, in a sentence.")
    advice: str = Field(description="What to do.")


Coordinate = Annotated[float, Field(ge=-(2**17), le=2**17)]


class MarkerSeen(BaseModel):
    """A marker that was read in a photo."""

    id: int
    corners: Annotated[list[tuple[Coordinate, Coordinate]], Field(min_length=4, max_length=4)] = Field(
        description="x, y of its top-left, top-right, bottom-right, bottom-left corner, in pixels of the upright photo."
    )


class PhotoJudgement(Judged):
    """The judgement of a photo."""

    kind: Literal["photo"] = "photo"
    width: int | None = Field(description="Pixels of the upright photo.")
    height: int | None
    sharpness: float | None = Field(description="In the least sharp direction; comparable within an acquisition.")
    marker_ids: list[int] = Field(description="Markers of the acquisition's dictionary that were read.")
    dictionary_seen: str | None = Field(description="Where the markers are of another dictionary: which.")
    same_as: str | None = Field(None, description="Where the same photo is there already: its label.")
    clipped: float | None = Field(None, description="Share of the photo that is overexposed; null where unknown.")
    markers: list[MarkerSeen] = Field(
        [], max_length=64, description="The markers with their corners; empty in judgements of earlier versions."
    )


class CubeJudgement(Judged):
    """The judgement of a file of a cube or a reference. An ENVI cube's header and data are judged together."""

    kind: Literal["cube"] = "cube"
    part: Literal["header", "data", "whole"]
    waiting_for: Literal["header", "data"] | None = Field(None, description="The other part, while it has not arrived.")
    rows: int | None = None
    cols: int | None = None
    bands: int | None = None
    interleave: str | None = None
    dtype: str | None = None
    quantity: Literal["reflectance", "counts"] | None = None
    expected_bytes: int | None = Field(None, description="Of the data, as the header says.")
    found_bytes: int | None = Field(None, description="Of the data, where they are too few.")
    field: str | None = Field(None, description="The header's field that is wrong.")
    wavelength_nm: tuple[float, float] | None = Field(None, description="Shortest and longest.")
    warnings: list[CubeNotice] = []


Judgement = Annotated[PhotoJudgement | CubeJudgement, Field(discriminator="kind")]


class File(BaseModel):
    """A file of an acquisition."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    role: Role
    label: str = Field(description="Its name in results.")
    name: str = Field(description="The name that the client gave; it is only shown.")
    size: int = Field(description="Bytes.")
    sha256: str
    state: Literal["accepted", "refused"] = Field(description="Refused files take no part in a job.")
    judgement: Judgement
    created_at: datetime.datetime


class FileCounts(BaseModel):
    """The files that have arrived."""

    photos: int = Field(description="Accepted photos.")
    refused: int = Field(description="Refused files of all roles.")
    cube: bool = Field(description="Whether the cube is complete.")
    white: bool
    dark: bool


def counts(files: Iterable[FileRow]) -> FileCounts:
    """Count the files of one acquisition."""
    rows = list(files)
    accepted = [row for row in rows if row.state == "accepted"]

    def complete(role: Role) -> bool:
        ends = {row.label.removeprefix(role) for row in accepted if row.role == role}
        return bool(ends - {HEADER, DATA}) or ends == {HEADER, DATA}

    return FileCounts(
        photos=sum(row.role == "photo" for row in accepted),
        refused=len(rows) - len(accepted),
        cube=complete("cube"),
        white=complete("white"),
        dark=complete("dark"),
    )

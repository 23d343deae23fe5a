"""Label layers as the API shows them."""

from __future__ import annotations

import datetime

from pydantic import BaseModel, ConfigDict, Field

from specimap_service.clouds.label_body import LabelClass, MadeBy


class Label(BaseModel):
    """A version of a label layer."""

    model_config = ConfigDict(from_attributes=True)

    cloud_id: str
    name: str
    version: int
    kind: str
    classes: list[LabelClass]
    made_by: MadeBy
    sha256: str = Field(description="Hash of values and metadata: equal content has an equal hash.")
    created_at: datetime.datetime
    created_by: str
    links: dict[str, str]


class LabelValues(BaseModel):
    """The values of a layer, in the order of the cloud's points."""

    cloud_id: str
    name: str
    version: int
    kind: str
    classes: list[LabelClass]
    values: list[int] | list[float | None] | list[list[float | None]] = Field(
        description="One for each point; for probabilities of several classes a list in the order of the classes."
    )

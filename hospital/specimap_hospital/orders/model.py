"""An order as it is asked for, and as it is found."""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from specimap_infra.study_context import StudyContext

MOST_ORDERS = 50
# Without the wildcards, which would list other people's orders.
_PLAIN = r"^[^\x00-\x1f\x7f\\*?]*$"
Short = Annotated[str, StringConstraints(strip_whitespace=True, max_length=16, pattern=_PLAIN)]
Long = Annotated[str, StringConstraints(strip_whitespace=True, max_length=64, pattern=_PLAIN)]


class OrderQuery(BaseModel):
    """What an order is looked up by: at least one of the three."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, json_schema_extra={"example": {"accession_number": "A-2026-0117"}}
    )

    accession_number: Short = Field(default="", description="Of the order.")
    patient_id: Long = Field(default="", description="Of the patient.")
    station: Short = Field(default="", description="Title of the station that the step is scheduled for.")

    @model_validator(mode="after")
    def _asks_for_something(self) -> OrderQuery:
        if not (self.accession_number or self.patient_id or self.station):
            raise ValueError("give an accession number, a patient id or a station")
        return self


class Order(BaseModel):
    """An order that was found: what a study context takes from it, and what helps to choose."""

    source: Literal["worklist", "qido"] = Field(description="Where it was found.")
    study: StudyContext = Field(description="PUT it as the acquisition's study context to choose the order.")
    scheduled_at: datetime.datetime | None = Field(default=None, description="Local time of the hospital.")
    station: str = Field(default="", description="The station that it is scheduled for.")
    modality: str = ""
    description: str = Field(default="", description="Of the procedure.")


class Orders(BaseModel):
    """The orders that were found."""

    orders: list[Order] = Field(max_length=MOST_ORDERS)
    more: bool = Field(description="Whether there are more than could be answered with.")
    unreadable: int = Field(description="Orders that were left out, since who they are about does not read.")

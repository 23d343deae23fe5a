"""Requests for jobs, and lines of their logs."""

from __future__ import annotations

import datetime
from typing import Annotated, Any

from fastapi import Header, Query
from pydantic import BaseModel, ConfigDict, Field

from specimap_infra.job_schemas import JobFailure, JobSettings, JobState, PriorityName
from specimap_infra.jobs import Level, Stage
from specimap_service.idempotency import digest_of

AfterJob = Annotated[str | None, Query(pattern=r"^job_[0-9a-z]{26}$", description="`next` of the page before.")]
AfterSeq = Annotated[int | None, Query(ge=0, lt=2**31, description="Only events after the one of this number.")]
LastEventId = Annotated[
    str | None, Header(pattern=r"^\d{0,9}$", description="Number of the last event seen; the stream goes on after it.")
]


class Webhook(BaseModel):
    """An address that is notified when the job has ended."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"url": "https://pacs.example/specimap", "secret": "0f6a3c0b1d5e4a7f"}},
    )

    url: str = Field(max_length=2000, description="Its host must be one that the service may send to.")
    secret: str = Field(
        min_length=16,
        max_length=256,
        repr=False,
        description="Key of the signature in `X-Specimap-Signature`: `t=<unix seconds>,v1=<hex>`, HMAC-SHA256 of "
        "`<t>.<body>`.",
    )


class JobRequest(BaseModel):
    """A job to be created."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {
                "acquisition_id": "acq_01k00000000000000000000000",
                "settings": {"method": "camera", "r_pc": 0.5},
                "priority": "intraoperative",
            }
        },
    )

    acquisition_id: str = Field(pattern=r"^acq_[0-9a-z]{26}$")
    settings: JobSettings = Field(default_factory=JobSettings)
    priority: PriorityName = "routine"
    webhook: Webhook | None = None

    def digest(self) -> str:
        """Return a hash that is the same for the same request."""
        return digest_of(self.model_dump(mode="json"))


class RerunRequest(BaseModel):
    """A job to be created with another one's settings, but for those given here."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"settings": {"r_pc": 0.25}}})

    settings: JobSettings | None = Field(default=None, description="Settings left out stay as they were.")
    priority: PriorityName | None = Field(default=None, description="By default unchanged.")
    webhook: Webhook | None = Field(default=None, description="By default unchanged; null sends nothing.")

    def digest(self, job_id: str) -> str:
        """Return a hash that is the same for the same request."""
        return digest_of({"rerun": job_id, **self.model_dump(mode="json", exclude_unset=True)})


class LogLine(BaseModel):
    """A line of a job's log."""

    seq: int = Field(description="The event's number; the numbers between are events of another type.")
    at: datetime.datetime
    level: str
    message: str
    data: dict[str, Any]


# ---- events -------------------------------------------------------------------------------------------


class JobStateEvent(BaseModel):
    """The job has another state; after a final one there is no event."""

    model_config = ConfigDict(json_schema_extra={"example": {"state": "running", "starts": 1}})

    state: JobState
    starts: int | None = Field(None, description="How often a worker took it up; left out in a final state.")
    error: JobFailure | None = Field(None, description="In a final state: why it failed.")
    cloud_id: str | None = Field(None, description="In a final state: the result, if it succeeded.")


class JobProgressEvent(BaseModel):
    """The stage that runs has come further."""

    model_config = ConfigDict(json_schema_extra={"example": {"stage": "reconstruct", "progress": 0.25}})

    stage: Stage
    progress: float = Field(ge=0, le=1, description="Share of the stage that is done.")


class JobLogEvent(BaseModel):
    """A line was added to the log."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"level": "info", "message": "24 photos are used.", "data": {}}}
    )

    level: Level
    message: str
    data: dict[str, Any]


EVENT_TYPES: dict[str, type[BaseModel]] = {
    "state": JobStateEvent,
    "progress": JobProgressEvent,
    "log": JobLogEvent,
}
"""What each type of event holds, by its name in the stream."""

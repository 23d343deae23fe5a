"""A job's settings, and a job as clients see it: the API answers with it, a webhook carries it."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.orm import Session

from specimap_core.errors import SettingsError
from specimap_core.pipeline.options import (
    DEFAULTS,
    OPTIONS,
    Adjustment,
    Backend,
    Dictionary,
    Features,
    Method,
)
from specimap_infra.tables import PRIORITIES, QUEUED, Acquisition, CloudRow, Job

FEW = 4
"""Jobs up to which each one's place in the queue is counted for itself."""
JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
PriorityName = Literal["intraoperative", "routine", "research"]


def _option(name: str) -> Any:
    """A field with the default, the range and the meaning of the run's option of that name."""
    option = OPTIONS[name]
    bounds = {} if option.choices else _bounds(name)
    return Field(default=getattr(DEFAULTS, name), description=option.meaning, **bounds)


def _bounds(name: str) -> dict[str, Any]:
    low, high = OPTIONS[name].bounds
    whole = isinstance(getattr(DEFAULTS, name), int)
    return {"ge": low, "le": high, **({} if whole else {"allow_inf_nan": False})}


EdgeMm = Annotated[float, Field(description=OPTIONS["edge_mm"].meaning, **_bounds("edge_mm"))]


class JobSettings(BaseModel):
    """What a person chooses of a run; what is left out is as published."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"method": "camera", "r_pc": 0.5}})

    method: Method = _option("method")
    adjustment: Adjustment = _option("adjustment")
    r_pc: float = _option("r_pc")
    r_reg: float = _option("r_reg")
    backend: Backend = _option("backend")
    features: Features = _option("features")
    working_px: int = _option("working_px")
    dictionary: Dictionary | None = Field(default=None, description="Marker dictionary; by default the acquisition's.")
    edge_mm: EdgeMm | None = Field(default=None, description="Edge of a marker, mm; by default the acquisition's.")

    def on(self, acquisition: Acquisition) -> dict[str, Any]:
        """All settings with values, what is left out taken from the acquisition: the arguments of a run.

        Raises:
            SettingsError: what the acquisition says cannot be used.
        """
        given = self.model_dump(exclude_none=True)
        own = {"dictionary": acquisition.dictionary, "edge_mm": acquisition.edge_mm}
        return job_settings({**own, **given}).model_dump()


def job_settings(given: dict[str, Any]) -> JobSettings:
    """Settings from a row or a program.

    Raises:
        SettingsError: a setting is unknown or out of its range; details name the first.
    """
    try:
        return JobSettings.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"{name}: {first['msg']}.", advice="Correct the job's settings.", setting=name) from error


class JobFailure(BaseModel):
    """Why a job failed."""

    code: str = Field(description="Stable code; docs/errors.md lists all.")
    message: str
    advice: str
    details: dict[str, Any]


class JobView(BaseModel):
    """A run of the pipeline on an acquisition."""

    model_config = ConfigDict(title="Job")

    id: str
    acquisition_id: str
    settings: JobSettings
    priority: PriorityName
    state: JobState
    stage: Literal["reconstruct", "adjust", "render", "register"] | None = Field(
        description="The stage it is in, or was in last."
    )
    progress: float = Field(description="Share of the stage that is done, 0 to 1.")
    error: JobFailure | None
    starts: int = Field(description="How often a worker took it up.")
    rerun_of: str | None = Field(description="The job that this one repeats.")
    cloud_id: str | None = Field(description="Its result, once it has succeeded.")
    seconds: dict[str, float] = Field(description="Time that each stage took, by its name.")
    created_at: datetime.datetime
    started_at: datetime.datetime | None
    finished_at: datetime.datetime | None
    queue_position: int | None = Field(description="Queued jobs that come before it; null unless it is queued.")


def job_views(session: Session, jobs: list[Job]) -> list[JobView]:
    """Jobs as clients see them, in the given order."""
    ids = [job.id for job in jobs]
    rows = session.execute(sa.select(CloudRow.job_id, CloudRow.id).where(CloudRow.job_id.in_(ids)))
    clouds = {row.job_id: row.id for row in rows}
    positions = queue_positions(session, [job.id for job in jobs if job.state == "queued"])
    names = {number: name for name, number in PRIORITIES.items()}
    return [
        JobView.model_validate(
            {
                "id": job.id,
                "acquisition_id": job.acquisition_id,
                "settings": job.settings,
                "priority": names[job.priority],
                "state": job.state,
                "stage": job.stage,
                "progress": job.progress,
                "error": job.error,
                "starts": job.starts,
                "rerun_of": job.rerun_of,
                "cloud_id": clouds.get(job.id),
                "seconds": job.seconds,
                "created_at": job.created_at,
                "started_at": job.started_at,
                "finished_at": job.finished_at,
                "queue_position": positions.get(job.id),
            }
        )
        for job in jobs
    ]


def queue_positions(session: Session, ids: list[str]) -> dict[str, int]:
    """How many queued jobs come before each of these, by priority, then age."""
    if len(ids) <= FEW:
        return {job_id: _queue_position(session, job_id) for job_id in ids}
    place = sa.func.row_number().over(order_by=(Job.priority, Job.created_at, Job.id)) - 1
    queued = sa.select(Job.id, place.label("place")).where(QUEUED).subquery()
    rows = session.execute(sa.select(queued.c.id, queued.c.place).where(queued.c.id.in_(ids)))
    return {job_id: int(position) for job_id, position in rows}


def _queue_position(session: Session, job_id: str) -> int:
    """Count those before one job, which takes no sorting of all."""
    job = session.get_one(Job, job_id)
    place = sa.tuple_(Job.priority, Job.created_at, Job.id)
    own = sa.tuple_(
        *(
            sa.literal(value, column.type)
            for column, value in ((Job.priority, job.priority), (Job.created_at, job.created_at), (Job.id, job.id))
        )
    )
    return session.scalar(sa.select(sa.func.count()).select_from(Job).where(QUEUED, place < own)) or 0

"""Workers, their leases and their stages."""

from __future__ import annotations

from pydantic import BaseModel, Field, ValidationInfo, field_validator


class WorkerSettings(BaseModel):
    """Workers."""

    slots: int = Field(default=1, ge=1, le=64, description="Jobs that one `specimap worker` runs side by side.")
    heartbeat_seconds: float = Field(default=2.0, gt=0, description="How often a worker says that it is alive.")
    lease_seconds: float = Field(
        default=10.0,
        gt=0,
        validate_default=True,
        description="Silence after which a worker counts as dead and its jobs go to another.",
    )
    stage_seconds: float = Field(default=1800, gt=0, description="Longest time that one stage may take.")
    stage_memory_bytes: int = Field(
        default=0, ge=0, description="Most address space that a stage's process may take; 0 sets no limit."
    )
    starts: int = Field(
        default=3,
        ge=1,
        description="Starts of one stage after which a job is failed whose process keeps ending by itself.",
    )
    interruptions: int = Field(
        default=30,
        ge=1,
        description="Times in one stage that a job's worker may die, or its process be killed from outside, before the job counts as the cause and is failed.",
    )

    patience_seconds: float = Field(
        default=300,
        gt=0,
        description="How long a worker waits for an unreachable storage before it gives up a job; for the database it waits without end.",
    )

    @field_validator("lease_seconds")
    @classmethod
    def _longer_than_heartbeats(cls, value: float, info: ValidationInfo) -> float:
        if value < 2 * info.data.get("heartbeat_seconds", 0):
            raise ValueError("is at least twice SPECIMAP_HEARTBEAT_SECONDS")
        return value

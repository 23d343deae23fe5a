"""How long things are kept."""

from __future__ import annotations

from pydantic import BaseModel, Field


class RetentionSettings(BaseModel):
    """What the hourly housekeeping keeps."""

    keep_event_days: float = Field(
        default=90, ge=0, description="Days after its end that a job's progress and log lines are kept; 0: for ever."
    )
    keep_workflow_days: float = Field(
        default=7,
        ge=0,
        description="Days that the job queue keeps what it knows of ended jobs and exports; 0: for ever.",
    )
    keep_artefact_days: float = Field(
        default=30,
        ge=0,
        description="Days after the last job of an acquisition that results of its earlier stages are kept, which a rerun would use; 0: for ever.",
    )
    keep_export_days: float = Field(
        default=30, ge=0, description="Days that exported files are kept, which can be made again; 0: for ever."
    )
    keep_upload_days: float = Field(
        default=30, ge=0, description="Days after its expiry that the state of an ended upload is kept; 0: for ever."
    )
    keep_delivery_days: float = Field(
        default=30, ge=0, description="Days that the state of an ended webhook delivery is kept; 0: for ever."
    )
    keep_label_versions: int = Field(
        default=0, ge=0, description="Versions of each label layer that are kept, the newest ones; 0: all."
    )
    keep_audit_days: float = Field(
        default=3650, ge=0, description="Days that entries of the audit trail are kept; 0: for ever."
    )

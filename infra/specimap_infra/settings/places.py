"""Where data are: database, storage, scratch files."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import BaseModel, Field, field_validator


def _data_dir() -> Path:
    home = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(home) / "specimap"


class PlaceSettings(BaseModel):
    """Places of data."""

    data_dir: Path = Field(
        default_factory=_data_dir,
        description="Folder of the database, the storage and scratch files, where these are not set.",
    )
    database_url: str = Field(
        default="",
        description="`sqlite:///FILE` or `postgresql://USER:PASSWORD@HOST/NAME`; by default SQLite in the data folder.",
    )
    storage: str = Field(
        default="", description="A folder, or `s3://BUCKET/PREFIX`; by default a folder in the data folder."
    )
    s3_endpoint: str = Field(
        default="",
        description="Endpoint of an S3-compatible store other than AWS; keys come from `AWS_ACCESS_KEY_ID` and `AWS_SECRET_ACCESS_KEY`.",
    )
    s3_region: str = Field(default="us-east-1", description="Region of the bucket.")
    scratch_dir: Path | None = Field(
        default=None, description="Folder on a local disk for uploads under way and running stages."
    )

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, value: str) -> str:
        if value and not value.startswith(("sqlite:///", "postgresql://", "postgresql+psycopg://")):
            raise ValueError("starts with sqlite:/// or postgresql://")
        return value

    @field_validator("storage")
    @classmethod
    def _known_storage(cls, value: str) -> str:
        if "://" in value and (not value.startswith("s3://") or len(value) == len("s3://")):
            raise ValueError("is a folder, or s3://BUCKET/PREFIX")
        return value

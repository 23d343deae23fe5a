"""What may be uploaded, and what the processes that read it may take."""

from __future__ import annotations

from pydantic import BaseModel, Field

from specimap_core.sandbox import Mode
from specimap_infra.settings.units import GIB, MIB


class UploadSettings(BaseModel):
    """Uploads and their judging."""

    max_photo_bytes: int = Field(default=64 * MIB, ge=1, description="Largest photo.")
    max_photo_pixels: int = Field(
        default=60_000_000,
        ge=1_000_000,
        description="Most pixels of a photo that is decoded whole: anything but a JPEG that is not progressive, which comes reduced and may have 250 million.",
    )
    max_cube_bytes: int = Field(default=8 * GIB, ge=1, description="Largest cube file.")
    max_photos: int = Field(default=300, ge=1, description="Largest number of photos of one acquisition.")
    quota_bytes: int = Field(
        default=200 * GIB,
        ge=1,
        description="Bytes that the acquisitions and labels of one key may hold, unless the key says otherwise.",
    )
    min_free_bytes: int = Field(
        default=2 * GIB,
        ge=0,
        description="Free space below which new uploads and labels are refused, so that running jobs can finish.",
    )
    upload_hours: float = Field(default=48, gt=0, description="Hours after which an unfinished upload is dropped.")
    judge_seconds: float = Field(default=60, gt=0, description="Longest time that the judging of one file may take.")
    judge_memory_bytes: int = Field(
        default=3 * GIB, ge=256 * MIB, description="Largest memory that the judging of files may take."
    )

    sandbox: Mode = Field(
        default="best-effort",
        description="Whether what reads uploaded files is confined to them by the kernel: `require` refuses to start where it cannot be, `best-effort` warns, `off` does without.",
    )

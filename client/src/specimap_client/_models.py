"""What the service answers, as frozen dataclasses. Times are aware, in UTC; sizes are bytes."""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from specimap_client._decode import Model

FINAL_STATES = frozenset({"succeeded", "failed", "cancelled"})


@dataclass(frozen=True, kw_only=True)
class Failure(Model):
    """Why something failed: a stable code, what is wrong, what to do, values for programs."""

    code: str
    message: str
    advice: str = ""
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class AcquisitionFiles(Model):
    """Files of an acquisition: how many photos were accepted and refused, and what else is there."""

    photos: int
    refused: int
    cube: bool
    white: bool
    dark: bool


@dataclass(frozen=True, kw_only=True)
class Acquisition(Model):
    """What was captured of one specimen; ``missing`` says in sentences what a job still needs."""

    id: str
    specimen_id: str
    accession_number: str | None = None
    dictionary: str
    edge_mm: float
    notes: str
    created_at: datetime.datetime
    created_by: str
    files: AcquisitionFiles
    ready: bool
    missing: tuple[str, ...]
    project_id: str | None = None


@dataclass(frozen=True, kw_only=True)
class File(Model):
    """A file of an acquisition. ``label`` is the name that reports speak of, ``name`` the one it came with."""

    id: str
    role: str
    label: str
    name: str
    size: int
    sha256: str
    state: str
    judgement: dict[str, Any]
    created_at: datetime.datetime
    path: Path | None = None
    """The file on this machine, where it was just uploaded."""

    @property
    def refused(self) -> bool:
        """Whether it takes no part in a job and is to be retaken."""
        return self.state == "refused"

    @property
    def verdict(self) -> str:
        """``accepted``, ``doubtful`` or ``refused``."""
        return str(self.judgement.get("verdict") or self.state)

    @property
    def reason(self) -> str:
        """Why it is doubtful or refused; empty where it is accepted."""
        return str(self.judgement.get("reason") or "")

    @property
    def advice(self) -> str:
        """What to do about it; empty where there is nothing to do."""
        return str(self.judgement.get("advice") or "")


@dataclass(frozen=True, kw_only=True)
class Job(Model):
    """A run of the pipeline. ``progress`` is the share of the running ``stage``, 0 to 1; ``seconds`` are per stage."""

    id: str
    acquisition_id: str
    settings: dict[str, Any]
    priority: str
    state: str
    stage: str | None = None
    progress: float
    error: Failure | None = None
    starts: int
    rerun_of: str | None = None
    cloud_id: str | None = None
    seconds: dict[str, float]
    created_at: datetime.datetime
    started_at: datetime.datetime | None = None
    finished_at: datetime.datetime | None = None
    queue_position: int | None = None

    @property
    def final(self) -> bool:
        """Whether it has ended, in whatever way."""
        return self.state in FINAL_STATES


@dataclass(frozen=True, kw_only=True)
class Event(Model):
    """Something that happened to a job: ``type`` is ``state``, ``progress`` or ``log``; resume after ``seq``."""

    seq: int
    type: str
    data: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class LogLine(Model):
    """A line of a job's log."""

    seq: int
    at: datetime.datetime
    level: str
    message: str
    data: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Export(Model):
    """A file made from a result; ``state`` as of a job."""

    id: str
    cloud_id: str
    format: str
    state: str
    size: int | None = None
    error: Failure | None = None

    @property
    def final(self) -> bool:
        """Whether it has ended, in whatever way."""
        return self.state in FINAL_STATES


@dataclass(frozen=True, kw_only=True)
class Project(Model):
    """A group of keys that share their acquisitions and results."""

    id: str
    name: str
    created_at: datetime.datetime


@dataclass(frozen=True, kw_only=True)
class Key(Model):
    """A key, without its secret."""

    id: str
    project_id: str | None = None
    name: str
    scopes: tuple[str, ...]
    created_at: datetime.datetime
    expires_at: datetime.datetime | None = None
    revoked_at: datetime.datetime | None = None
    last_used_at: datetime.datetime | None = None
    rate_per_minute: int | None = None
    quota_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class NewKey(Key):
    """A key that was just made; ``key`` is shown this once and kept nowhere."""

    raw: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    key: str = field(repr=False)


@dataclass(frozen=True, kw_only=True)
class Point(Model):
    """One point of a cloud: mm in the marker frame, unit normal, row and column in the cube, its spectrum."""

    index: int
    xyz: tuple[float, ...]
    normal: tuple[float, ...]
    rgb: tuple[int, ...]
    hsi_pixel: tuple[int, ...]
    sigma_mm: float | None
    flags: int
    flag_names: tuple[str, ...]
    labels: dict[str, Any]
    quantity: str
    wavelength_nm: tuple[float | None, ...]
    spectrum: tuple[float, ...]
    """NaN where it has no value."""

    @classmethod
    def of(cls, data: object) -> Self:
        """See :meth:`Model.of`."""
        if isinstance(data, dict) and isinstance(data.get("spectrum"), list):
            data = {**data, "spectrum": [math.nan if value is None else value for value in data["spectrum"]]}
        return super().of(data)


@dataclass(frozen=True)
class Progress:
    """How far an upload or a download is, in bytes: this file, and all files of the call."""

    name: str
    sent: int
    size: int
    total_sent: int
    total_size: int


class Identified(Protocol):
    """Whatever the service has given an id."""

    @property
    def id(self) -> str:
        """The id."""


def id_of(thing: Identified | str) -> str:
    """The id of something that the service has, or the id itself."""
    return thing if isinstance(thing, str) else thing.id

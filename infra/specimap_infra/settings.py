"""All settings of the service and its workers, from the environment and a file, read when a program starts."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pydantic import Field, PrivateAttr, ValidationError, ValidationInfo, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from specimap_core.errors import SettingsError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES, backends_from
from specimap_core.sandbox import Mode

CONFIG_VARIABLE = "SPECIMAP_CONFIG"
"""Names a TOML file with the same settings, lower case and without the prefix; the environment wins."""
MIB = 1024**2
GIB = 1024**3


def _data_dir() -> Path:
    home = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(home) / "specimap"


def _config_file() -> Path | None:
    file = os.environ.get(CONFIG_VARIABLE)
    return Path(file) if file else None


class ServiceSettings(BaseSettings):
    """One field a setting; the environment variable is its name in capitals after ``SPECIMAP_``."""

    model_config = SettingsConfigDict(env_prefix="SPECIMAP_", extra="forbid", frozen=True)

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

    host: str = Field(
        default="127.0.0.1", description="Address to listen on; anything but loopback needs a TLS proxy in front."
    )
    port: int = Field(default=8765, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    public_url: str = Field(default="", description="How clients reach the service, where a proxy stands in front.")
    cors_origins: list[str] = Field(
        default_factory=list, description="Web origins that may call the API, as a JSON list."
    )
    rate_per_minute: int = Field(
        default=6000, ge=1, description="Requests a minute that a key may make, unless the key says otherwise."
    )
    session_hours: float = Field(
        default=12, gt=0, le=720, description="Hours after which a person who signed in on a page signs in again."
    )
    max_connections: int = Field(
        default=1000, ge=1, description="Connections that the API takes at a time; it raises its limit of open files."
    )
    max_connections_per_address: int = Field(
        default=900,
        ge=1,
        description="Connections of one address; a proxy has one address, and what is left serves health checks.",
    )
    max_streams_per_key: int = Field(
        default=100, ge=1, description="Streams of job events that one key may follow at a time, in each API process."
    )
    head_seconds: float = Field(default=30, gt=0, description="Longest time that the head of a request may take.")
    keep_alive_seconds: float = Field(
        default=75,
        gt=0,
        description="How long a connection may wait for its next request; longer than a proxy keeps its own.",
    )
    silence_seconds: float = Field(
        default=60,
        gt=0,
        description="Silence in a body, or in the reading of an answer, after which a connection is closed.",
    )

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

    webhook_hosts: list[str] = Field(
        default_factory=list,
        description="Hosts that webhooks may be sent to, as a JSON list; none by default, so nothing leaves the machine.",
    )
    webhook_attempts: int = Field(default=8, ge=1, description="Attempts to deliver a webhook, at growing intervals.")

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

    log_level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Lowest level that is logged."
    )
    log_format: Literal["json", "text"] = Field(
        default="json", description="One JSON object a line, or lines for a person."
    )

    _config_file: Path | None = PrivateAttr(default_factory=_config_file)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Arguments win over the environment, the environment over the file."""
        file, sources = _config_file(), (init_settings, env_settings)
        return (*sources, TomlConfigSettingsSource(settings_cls, file)) if file else sources

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

    @field_validator("lease_seconds")
    @classmethod
    def _longer_than_heartbeats(cls, value: float, info: ValidationInfo) -> float:
        if value < 2 * info.data.get("heartbeat_seconds", 0):
            raise ValueError("is at least twice SPECIMAP_HEARTBEAT_SECONDS")
        return value

    @property
    def database(self) -> str:
        """SQLAlchemy URL."""
        url = self.database_url or f"sqlite:///{self.data_dir / 'specimap.db'}"
        return url.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def storage_place(self) -> str:
        """A folder or an S3 address."""
        return self.storage or str(self.data_dir / "storage")

    @property
    def scratch(self) -> Path:
        """Folder for what is under way; on a local disk."""
        return self.scratch_dir or self.data_dir / "scratch"

    @property
    def private_places(self) -> list[Path]:
        """Local folders and files that no process which reads uploaded files may see as a whole."""
        places = [self.data_dir, self.scratch]
        if not self.storage_place.startswith("s3://"):
            places.append(Path(self.storage_place))
        if self.database.startswith("sqlite:///"):
            # With its journals, which come and go next to it.
            places.append(Path(self.database.removeprefix("sqlite:///")).parent)
        if self._config_file is not None:
            places.append(self._config_file)
        return [place.absolute() for place in places]


def load_settings(**given: object) -> ServiceSettings:
    """Read the settings; ``given`` values win over environment and file.

    Raises:
        SettingsError: a value cannot be; the message names the variable.
    """
    file = _config_file()
    if file is not None and not file.is_file():
        raise SettingsError(
            f"{CONFIG_VARIABLE} names {file}, which does not exist.",
            advice="Name a TOML file.",
            setting=CONFIG_VARIABLE,
        )
    known = known_variables()
    strange = sorted(name for name in os.environ if name.startswith("SPECIMAP_") and name not in known)
    if strange:
        raise SettingsError(
            f"There is no setting {strange[0]}.",
            advice="docs/settings.md lists all; correct the name or remove it.",
            setting=strange[0],
        )
    backends_from(os.environ)
    try:
        return ServiceSettings(**given)  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(str(part) for part in first["loc"][:1]) or "settings"
        raise SettingsError(
            f"SPECIMAP_{name.upper()}: {first['msg'].removeprefix('Value error, ')}.",
            advice="docs/settings.md lists the settings and what they take.",
            setting=name,
        ) from error
    except ValueError as error:  # the file is no TOML, or a list is no JSON
        raise SettingsError(
            f"The settings do not read: {error}.", advice="docs/settings.md lists the settings and what they take."
        ) from error


OTHER_VARIABLES = frozenset(
    {
        CONFIG_VARIABLE,
        "SPECIMAP_DEBUG",
        "SPECIMAP_KEY",
        "SPECIMAP_TEST_DATA",
        "SPECIMAP_TEST_OUTAGE_SECONDS",
        "SPECIMAP_URL",
    }
)
"""Variables with the prefix that are no settings of the service."""


def known_variables() -> frozenset[str]:
    """All variables with the prefix: of the service, of backends and devices, and others."""
    own = {f"SPECIMAP_{name.upper()}" for name in ServiceSettings.model_fields}
    return frozenset(own | OTHER_VARIABLES | set(BACKEND_VARIABLES))

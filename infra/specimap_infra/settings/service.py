"""All settings of the service and its workers, from the environment and a file, read when a program starts."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import PrivateAttr, ValidationError
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from specimap_core.errors import SettingsError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES, backends_from
from specimap_infra.settings.audit import AuditSettings
from specimap_infra.settings.fhir import FhirSettings
from specimap_infra.settings.hospital import HospitalSettings
from specimap_infra.settings.identity import IdentitySettings
from specimap_infra.settings.logging import LogSettings
from specimap_infra.settings.pairs import check_pairs
from specimap_infra.settings.places import PlaceSettings
from specimap_infra.settings.privacy import PrivacySettings
from specimap_infra.settings.retention import RetentionSettings
from specimap_infra.settings.server import ServerSettings
from specimap_infra.settings.uploads import UploadSettings
from specimap_infra.settings.webhooks import WebhookSettings
from specimap_infra.settings.workers import WorkerSettings

CONFIG_VARIABLE = "SPECIMAP_CONFIG"
"""Names a TOML file with the same settings, lower case and without the prefix; the environment wins."""


def _config_file() -> Path | None:
    file = os.environ.get(CONFIG_VARIABLE)
    return Path(file) if file else None


class ServiceSettings(
    # The last one's fields come first.
    LogSettings,
    HospitalSettings,
    AuditSettings,
    PrivacySettings,
    RetentionSettings,
    FhirSettings,
    WebhookSettings,
    WorkerSettings,
    UploadSettings,
    IdentitySettings,
    ServerSettings,
    PlaceSettings,
    BaseSettings,
):
    """One field a setting; the environment variable is its name in capitals after ``SPECIMAP_``."""

    model_config = SettingsConfigDict(env_prefix="SPECIMAP_", extra="forbid", frozen=True)

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
    def has_hospital_process(self) -> bool:
        """Whether a process of the hospital's side has work."""
        return self.sends_dicom or bool(self.dicom_port or self.fhir_url or self.audit_syslog)

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
        settings = ServiceSettings(**given)  # type: ignore[arg-type]
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
    check_pairs(settings)
    return settings


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

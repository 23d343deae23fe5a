"""Privacy: keys of pseudonyms and certificates, and how long acquisitions are kept."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, Field, SecretStr, field_validator

from specimap_infra.settings.audit import checked_secret


class PrivacySettings(BaseModel):
    """De-identified exports, retention of acquisitions, erasure."""

    pseudonym_secret: SecretStr = Field(
        default=SecretStr(""),
        description="Secret, 32 characters or more, from which de-identified exports derive their pseudonyms: the same input has the same pseudonym until it is changed. Without it there are no such exports.",
    )
    signing_key: Path | None = Field(
        default=None,
        description="PEM file with the Ed25519 key that signs certificates of erasure; by default `signing-key.pem` in the data folder, made when it is first needed.",
    )
    keep_acquisition_days: float = Field(
        default=0,
        ge=0,
        description="Days after its last job, or its creation, that an acquisition is kept with all its results; 0: for ever.",
    )
    keep_acquisition_days_of: dict[str, float] = Field(
        default_factory=dict,
        description="The same for single projects, by name or id, as a JSON object; it wins over the general rule, also with 0.",
    )
    keep_labelled: bool = Field(
        default=True, description="Whether acquisitions with label layers are kept, however old they are."
    )

    @field_validator("pseudonym_secret")
    @classmethod
    def _pseudonym_secret_long_enough(cls, value: SecretStr) -> SecretStr:
        return checked_secret(value)

    @field_validator("keep_acquisition_days_of")
    @classmethod
    def _not_negative(cls, value: dict[str, float]) -> dict[str, float]:
        if any(days < 0 for days in value.values()):
            raise ValueError("has numbers of 0 or more")
        return value

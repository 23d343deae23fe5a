"""The FHIR server that is told of results."""

from __future__ import annotations

from pydantic import BaseModel, Field, SecretStr, field_validator


class FhirSettings(BaseModel):
    """The FHIR server, and the hospital's systems of identifiers."""

    fhir_url: str = Field(
        default="",
        description="Base address of the FHIR R4 server that is told of results with a study context; none by default.",
    )
    fhir_token: SecretStr = Field(default=SecretStr(""), description="Bearer token for the FHIR server.")
    fhir_token_url: str = Field(
        default="", description="Where tokens for the FHIR server come from (OAuth 2, client credentials)."
    )
    fhir_client_id: str = Field(default="", description="Client id for those tokens.")
    fhir_client_secret: SecretStr = Field(default=SecretStr(""), description="Client secret for those tokens.")
    fhir_ca_file: str = Field(
        default="", description="PEM file of the authority that signed the FHIR server's certificate."
    )
    fhir_patient_system: str = Field(default="", description="URI of the hospital's patient ids.")
    fhir_accession_system: str = Field(default="", description="URI of the hospital's accession numbers.")
    fhir_specimen_system: str = Field(default="", description="URI of the hospital's specimen ids.")
    fhir_attempts: int = Field(
        default=50, ge=1, description="Attempts to tell the FHIR server of a result, at growing intervals."
    )

    @field_validator("fhir_url", "fhir_token_url")
    @classmethod
    def _fhir_address(cls, value: str) -> str:
        if value and not value.startswith(("https://", "http://")):
            raise ValueError("is an address that starts with https:// (or http://)")
        return value.rstrip("/")

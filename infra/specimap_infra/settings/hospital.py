"""What joins the service to a hospital: study contexts, orders, the archive, DICOM in."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field, SecretStr, field_validator

from specimap_infra.study_keys import KeyTextError, StudyKey


class StudySettings(BaseModel):
    """Study contexts."""

    study_keys: list[SecretStr] = Field(
        default_factory=list,
        description="Keys that patient data are encrypted with, as a JSON list, the newest first; without one no study context is kept. `specimap contexts new-key` makes one.",
    )

    @field_validator("study_keys")
    @classmethod
    def _readable_keys(cls, value: list[SecretStr]) -> list[SecretStr]:
        try:
            keys = [StudyKey.of(text.get_secret_value()) for text in value]
        except KeyTextError:
            # The value is a secret, and the message of a wrong setting is logged.
            raise ValueError("each is 32 random bytes in base64, as specimap contexts new-key makes them") from None
        if len({key.id for key in keys}) != len(keys):
            raise ValueError("a key stands twice")
        return value


class HospitalSettings(StudySettings):
    """Connections to a hospital's systems. None by default."""

    ae_title: str = Field(default="SPECIMAP", max_length=16, description="Own application entity title in DICOM.")
    hospital_ca_file: str = Field(
        default="",
        description="PEM file of the authorities that the hospital's servers are known by; else the system's.",
    )
    hospital_cert_file: str = Field(default="", description="PEM file of the client certificate for these servers.")
    hospital_key_file: str = Field(default="", description="PEM file of its private key.")

    worklist_host: str = Field(default="", description="Host of the modality worklist that orders are looked up in.")
    worklist_port: int = Field(default=104, ge=1, le=65535, description="Its port.")
    worklist_ae_title: str = Field(default="", max_length=16, description="Its application entity title.")
    worklist_tls: Literal["off", "on"] = Field(default="off", description="Whether the connection to it is encrypted.")
    orders_url: str = Field(
        default="",
        description="DICOMweb address (QIDO-RS) whose studies are looked up as orders, besides the worklist.",
    )
    orders_token: SecretStr = Field(default=SecretStr(""), description="Bearer token for it.")
    orders_user: str = Field(default="", description="User for it, where it takes a password.")
    orders_password: SecretStr = Field(default=SecretStr(""), description="The user's password.")
    orders_seconds: float = Field(default=10, gt=0, le=60, description="Longest time that an order is looked up.")

    pacs_url: str = Field(
        default="", description="DICOMweb address that results are sent to (STOW-RS); nothing is sent by default."
    )
    pacs_token: SecretStr = Field(default=SecretStr(""), description="Bearer token for it.")
    pacs_user: str = Field(default="", description="User for it, where it takes a password.")
    pacs_password: SecretStr = Field(default=SecretStr(""), description="The user's password.")
    pacs_host: str = Field(
        default="",
        description="Host of the archive's DICOM port: for C-STORE, where no `SPECIMAP_PACS_URL` is set or it does not answer, and for its commitment.",
    )
    pacs_port: int = Field(default=104, ge=1, le=65535, description="Its port.")
    pacs_ae_title: str = Field(default="", max_length=16, description="Its application entity title.")
    pacs_tls: Literal["off", "on"] = Field(default="off", description="Whether the connection to it is encrypted.")
    pacs_send: Literal["all", "requested"] = Field(
        default="all",
        description="`all`: each result whose acquisition has a study context; `requested`: those that somebody asks for.",
    )
    pacs_commitment: Literal["off", "on"] = Field(
        default="off",
        description="Whether the archive is asked to commit itself to what it was sent (Storage Commitment).",
    )
    pacs_attempts: int = Field(
        default=200, ge=1, description="Attempts to send a result, at growing intervals, before it counts as failed."
    )
    pacs_longest_wait_seconds: float = Field(default=900, gt=0, description="Longest interval between two attempts.")
    pacs_seconds: float = Field(default=60, gt=0, description="Longest time that the archive may take for one object.")
    keep_dicom_days: float = Field(
        default=365, ge=0, description="Days that the delivery states of sent objects are kept; 0: for ever."
    )

    dicom_host: str = Field(default="127.0.0.1", description="Address of the DICOM port.")
    dicom_port: int = Field(
        default=0, ge=0, le=65535, description="Port for C-ECHO, C-STORE and the archive's commitment; 0: none."
    )
    dicom_tls: Literal["off", "on"] = Field(
        default="off",
        description="Whether the DICOM port is encrypted; peers then show a certificate of the authority.",
    )
    dicom_peers: list[str] = Field(
        default_factory=list,
        description="Application entity titles that may use the DICOM port besides the archive's, as a JSON list.",
    )

    dicom_key: SecretStr = Field(
        default=SecretStr(""),
        description="Key (`spk_...`) with the scopes `upload` and `label` with which the DICOM port hands on what it is sent by C-STORE; without one it takes nothing.",
    )
    dicom_forward_url: str = Field(
        default="", description="Address of the API that it hands that to; by default that of this machine's service."
    )
    stow: Literal["off", "on"] = Field(default="off", description="Whether the API takes DICOM objects (STOW-RS).")
    most_dicom_bytes: int = Field(
        default=256 * 1024**2, ge=1, description="Largest DICOM object, and STOW-RS body, that is taken."
    )

    @field_validator("orders_url", "pacs_url", "dicom_forward_url")
    @classmethod
    def _web_address(cls, value: str) -> str:
        if value and (not value.startswith(("http://", "https://")) or "@" in value.split("/")[2]):
            raise ValueError("is http(s)://HOST/PATH, without a password")
        return value.rstrip("/")

    @property
    def sends_dicom(self) -> bool:
        """Whether there is an archive to send to."""
        return bool(self.pacs_url or self.pacs_host)

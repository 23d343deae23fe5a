"""The audit trail: its key, what it keeps of addresses, where it is forwarded to."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field, SecretStr, field_validator

SHORTEST_SECRET = 32


def checked_secret(value: SecretStr) -> SecretStr:
    """Return a secret that is empty or long enough. Raises ValueError for a short one."""
    if value.get_secret_value() and len(value.get_secret_value()) < SHORTEST_SECRET:
        raise ValueError(f"has {SHORTEST_SECRET} characters or more, such as `openssl rand -hex 32` prints")
    return value


class AuditSettings(BaseModel):
    """The audit trail."""

    audit_key: SecretStr = Field(
        default=SecretStr(""),
        description="Secret, 32 characters or more, with which the chain of the audit trail is sealed (HMAC-SHA-256); without it the chain is plain SHA-256.",
    )
    audit_old_keys: list[SecretStr] = Field(
        default_factory=list,
        description="Earlier values of `SPECIMAP_AUDIT_KEY`, as a JSON list, with which older entries are verified.",
    )
    audit_addresses: Literal["pseudonym", "full", "none"] = Field(
        default="pseudonym",
        description="What audit entries keep of the address of a request: a keyed pseudonym, the whole address, or nothing.",
    )
    audit_syslog: str = Field(
        default="",
        description="Syslog server that the audit trail is forwarded to: `tls://HOST:6514`, `tcp://HOST:514` or `udp://HOST:514`; none by default, so nothing leaves the machine.",
    )
    audit_syslog_format: Literal["dicom", "json"] = Field(
        default="dicom", description="What is forwarded: DICOM audit messages (PS3.15 A.5, XML), or lines of JSON."
    )
    audit_syslog_ca: Path | None = Field(
        default=None,
        description="PEM file of the authorities that the syslog server's certificate is checked against; by default the system's.",
    )
    audit_syslog_certificate: Path | None = Field(
        default=None, description="PEM file with the certificate, and its key, that is shown to the syslog server."
    )
    audit_source: str = Field(
        default="specimap", pattern=r"^[\x21-\x7e]{1,64}$", description="`AuditSourceID` of DICOM audit messages."
    )
    audit_site: str = Field(
        default="", pattern=r"^[\x21-\x7e]{0,64}$", description="`AuditEnterpriseSiteID` of DICOM audit messages."
    )

    @field_validator("audit_key")
    @classmethod
    def _audit_key_long_enough(cls, value: SecretStr) -> SecretStr:
        return checked_secret(value)

    @field_validator("audit_syslog")
    @classmethod
    def _known_scheme(cls, value: str) -> str:
        if value:
            scheme, _, rest = value.partition("://")
            host, _, port = rest.rpartition(":")
            if scheme not in ("tls", "tcp", "udp") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
                raise ValueError("is tls://HOST:PORT, tcp://HOST:PORT or udp://HOST:PORT")
        return value

"""Sign-in with an identity provider."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from pydantic import BaseModel, Field, SecretStr, ValidationInfo, field_validator

PERSON_ROLES = ("technician", "clinician", "classifier", "admin", "auditor")
"""Roles of people who sign in with an identity provider; the service's table of permissions says what each may."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")


class IdentitySettings(BaseModel):
    """The identity provider (OpenID Connect), and what its claims mean here."""

    oidc_client_id: str = Field(default="", description="Name of Specimap at the provider.")
    oidc_issuer: str = Field(
        default="",
        description="Address of the identity provider, as it calls itself; without one nobody signs in with it. Needs `SPECIMAP_OIDC_CLIENT_ID` and `SPECIMAP_PUBLIC_URL`.",
    )
    oidc_client_secret: SecretStr = Field(
        default=SecretStr(""),
        description="Secret of Specimap at the provider; empty for a public client, which PKCE alone protects.",
    )
    oidc_name: str = Field(
        default="",
        description="Name of the account on the sign-in page, such as the hospital's; by default its own words.",
    )
    oidc_scopes: str = Field(
        default="openid",
        description="What the sign-in asks the provider for, with blanks between; `openid` is among it.",
    )
    oidc_audience: str = Field(
        default="",
        description="Audience of the access tokens that programs send; without one, none are taken.",
    )
    oidc_algorithms: list[str] = Field(
        default_factory=lambda: ["RS256", "PS256", "ES256"],
        description="Signatures of tokens that count: of `RS256`, `RS384`, `RS512`, `PS256`, `PS384`, `PS512`, `ES256`, `ES384`, `ES512`, `EdDSA`.",
    )
    oidc_clock_skew_seconds: float = Field(
        default=30, ge=0, le=300, description="Most by which the provider's clock may differ."
    )
    oidc_ca_file: Path | None = Field(
        default=None, description="Certificates in PEM of the authority behind the provider's; by default the system's."
    )
    oidc_roles_claim: str = Field(
        default="roles", description="Claim with a person's roles; within others, with dots: `realm_access.roles`."
    )
    oidc_roles: dict[str, str] = Field(
        default_factory=dict,
        description='Which role each value of that claim gives, as JSON: `{"specimap-lab": "technician"}`. Roles: `technician`, `clinician`, `classifier`, `admin`, `auditor`.',
    )
    oidc_project: str = Field(
        default="default",
        description="Project, by name or id, of all who sign in, where `SPECIMAP_OIDC_PROJECTS_CLAIM` is empty.",
    )
    oidc_projects_claim: str = Field(
        default="",
        description="Claim with a person's groups, which give the projects: whoever is in no group sees no objects.",
    )
    oidc_projects: dict[str, str] = Field(
        default_factory=dict,
        description='Which project, by name or id, each value of that claim gives, as JSON: `{"breast-unit": "breast"}`.',
    )
    oidc_create_projects: bool = Field(
        default=False,
        description="Whether a group without an entry gives the project of its own name, which is made when first seen.",
    )

    @field_validator("oidc_issuer")
    @classmethod
    def _complete(cls, value: str, info: ValidationInfo) -> str:
        if not value:
            return value
        if not is_safe_address(value):
            raise ValueError("is an https:// address without a query; http:// on this machine alone")
        if not info.data.get("oidc_client_id"):
            raise ValueError("needs SPECIMAP_OIDC_CLIENT_ID")
        if not is_safe_address(info.data.get("public_url", "")):
            raise ValueError("needs SPECIMAP_PUBLIC_URL, to which the provider sends people back; an https:// address")
        return value

    @field_validator("oidc_scopes")
    @classmethod
    def _asks_for_identity(cls, value: str) -> str:
        if "openid" not in value.split():
            raise ValueError("has openid among it")
        return value

    @field_validator("oidc_algorithms")
    @classmethod
    def _asymmetric(cls, value: list[str]) -> list[str]:
        if not value or set(value) - ALGORITHMS:
            raise ValueError(f"is a list of some of {', '.join(sorted(ALGORITHMS))}")
        return value

    @field_validator("oidc_roles")
    @classmethod
    def _known_roles(cls, value: dict[str, str]) -> dict[str, str]:
        if set(value.values()) - set(PERSON_ROLES):
            raise ValueError(f"gives roles that there are: {', '.join(PERSON_ROLES)}")
        return value


ALGORITHMS = frozenset(f"{kind}{bits}" for kind in ("RS", "PS", "ES") for bits in (256, 384, 512)) | {"EdDSA"}
"""Signatures with a key pair: with a shared secret, whoever checks a token could make one."""


def is_safe_address(address: str) -> bool:
    """Return whether nobody on the way can read or change what is sent to an address."""
    try:
        parts = urlsplit(address)
        host = parts.hostname
    except ValueError:
        return False
    plain = parts.scheme == "http" and host in LOOPBACK
    return (parts.scheme == "https" or plain) and bool(host) and not (parts.query or parts.fragment or parts.username)

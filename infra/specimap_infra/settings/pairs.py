"""Settings that go together, and files that they name: checked at the start, before anything is half done."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import SecretStr

from specimap_core.errors import SettingsError

if TYPE_CHECKING:
    from specimap_infra.settings.service import ServiceSettings

NEEDS = {
    "pacs_host": ("pacs_ae_title",),
    "pacs_password": ("pacs_user",),
    "pacs_user": ("pacs_password",),
    "orders_password": ("orders_user",),
    "orders_user": ("orders_password",),
    "worklist_host": ("worklist_ae_title",),
    "fhir_token_url": ("fhir_client_id", "fhir_client_secret"),
    "hospital_key_file": ("hospital_cert_file",),
    "oidc_client_secret": ("oidc_issuer",),
}
"""Settings that are of no use without others."""
FILES = ("hospital_ca_file", "hospital_cert_file", "hospital_key_file", "fhir_ca_file")
ONE_OF = (("pacs_token", "pacs_user"), ("orders_token", "orders_user"), ("fhir_token", "fhir_token_url"))
"""Two ways to the same: only one of them counts, so that one of them is a mistake."""


def check_pairs(settings: ServiceSettings) -> None:
    """Refuse settings that would fail later, or would be ignored without a word.

    Raises:
        SettingsError: it names the variable.
    """
    for name, others in NEEDS.items():
        for other in others:
            if _is_set(settings, name) and not _is_set(settings, other):
                raise _refused(name, f"is set, and {_variable(other)} is not.", f"Set {_variable(other)} too.")
    for first, second in ONE_OF:
        if _is_set(settings, first) and _is_set(settings, second):
            raise _refused(second, f"is set beside {_variable(first)}.", "Set one of them.")
    if settings.dicom_port and settings.dicom_tls == "on" and not settings.hospital_cert_file:
        raise _refused("dicom_tls", "is on, and there is no certificate.", "Set SPECIMAP_HOSPITAL_CERT_FILE too.")
    for name in FILES:
        path = getattr(settings, name)
        if path and not (Path(path).is_file() and os.access(path, os.R_OK)):
            raise _refused(name, f"names {path}, which is no file that can be read.", "Name a PEM file.")


def _is_set(settings: ServiceSettings, name: str) -> bool:
    value = getattr(settings, name)
    return bool(value.get_secret_value() if isinstance(value, SecretStr) else value)


def _variable(name: str) -> str:
    return f"SPECIMAP_{name.upper()}"


def _refused(name: str, what: str, advice: str) -> SettingsError:
    return SettingsError(f"{_variable(name)} {what}", advice=advice, setting=name)

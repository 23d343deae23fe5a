"""Hands on what the DICOM port was sent to the API, which judges it as any other: by STOW-RS, with a key of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import SecretStr

from specimap_hospital.connections import PeerError, dicomweb, web_errors
from specimap_hospital.receive.classes import (
    CANNOT_PROCESS,
    CANNOT_UNDERSTAND,
    NOT_AUTHORISED,
    NOT_SUPPORTED,
    OUT_OF_RESOURCES,
)
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

SECONDS = 300.0
SUCCESS = 0x0000
CONFLICT = 409
OF_STORE = (CANNOT_PROCESS, NOT_SUPPORTED, NOT_AUTHORISED)


def forwarded(settings: ServiceSettings, dataset: Dataset) -> int:
    """Hand an object on. Returns the status for its sender: success, or why it was not taken."""
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    url = settings.dicom_forward_url or f"http://{host}:{settings.port}"
    client = dicomweb(
        settings, f"{url}/v1/dicomweb", token=settings.dicom_key, user="", password=SecretStr(""), seconds=SECONDS
    )
    import requests

    try:
        with web_errors():
            try:
                client.store_instances([dataset])
            except requests.HTTPError as error:
                # Nothing was taken: the answer says why.
                if error.response is None or error.response.status_code != CONFLICT:
                    raise
                return _failure(error.response.json())
    except PeerError as error:
        logger().warning("dicom object not handed on", reason=error.reason)
        if error.reason in ("http_401", "http_403"):
            return NOT_AUTHORISED
        return OUT_OF_RESOURCES if error.passing else CANNOT_UNDERSTAND
    finally:
        client._session.close()
    return SUCCESS


def _failure(answer: dict[str, Any]) -> int:
    code: int = answer["00081198"]["Value"][0]["00081197"]["Value"][0]
    if not 0 < code <= 0xFFFF:
        return CANNOT_UNDERSTAND
    # A C-STORE knows few codes; whatever else it is goes into those that mean that an object is not understood.
    return code if code in OF_STORE or code >= OUT_OF_RESOURCES else CANNOT_UNDERSTAND | code & 0x0FFF

"""Requests to the identity provider: to safe addresses alone, bounded in time and size, without redirects."""

from __future__ import annotations

import json
import ssl
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx

from specimap_core.errors import SettingsError
from specimap_infra.settings.identity import is_safe_address
from specimap_service.errors import IdentityUnavailableError

TIMEOUT_SECONDS = 5.0
MOST_SECONDS = 10.0
"""Of a whole answer, however slowly it comes."""
LARGEST_ANSWER = 1024 * 1024


def provider_client(ca_file: Path | None) -> httpx.Client:
    """Make a client that connects to the provider itself only: no proxy from the environment, no redirect.

    Raises:
        SettingsError: the file with certificates does not read.
    """
    try:
        context = ssl.create_default_context(cafile=None if ca_file is None else str(ca_file))
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(
            f"SPECIMAP_OIDC_CA_FILE: {ca_file} does not read as certificates in PEM.",
            advice="Name a file with the certificates of the authority behind the provider's.",
            setting="oidc_ca_file",
        ) from error
    return httpx.Client(
        trust_env=False,
        follow_redirects=False,
        timeout=TIMEOUT_SECONDS,
        verify=context,
        headers={"User-Agent": "specimap", "Accept": "application/json"},
    )


def unavailable(what: str) -> IdentityUnavailableError:
    """Make the error for a provider that does not answer as it should."""
    return IdentityUnavailableError(
        f"The identity provider does not help: {what}.",
        advice="Try again later, or sign in with a key. `specimap identity check` tells more.",
    )


def ask(
    client: httpx.Client,
    method: str,
    url: str,
    *,
    content: str = "",
    headers: Mapping[str, str] | None = None,
) -> tuple[int, dict[str, Any]]:
    """Make a request; return the status and the JSON object of its answer.

    Raises:
        IdentityUnavailableError: the address is not safe, no answer came in time, or it is no JSON object.
    """
    if not is_safe_address(url.partition("?")[0]):
        raise unavailable("it names an address that is not https")
    deadline, body = time.monotonic() + MOST_SECONDS, b""
    try:
        with client.stream(method, url, content=content or None, headers=dict(headers or {})) as answer:
            for part in answer.iter_bytes():
                body += part
                if len(body) > LARGEST_ANSWER or time.monotonic() > deadline:
                    raise unavailable("its answer is too large or too slow")
    except (httpx.HTTPError, httpx.InvalidURL) as error:
        raise unavailable(type(error).__name__) from error
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise unavailable(f"its answer with status {answer.status_code} is no JSON") from error
    if not isinstance(found, dict):
        raise unavailable(f"its answer with status {answer.status_code} is no JSON object")
    return answer.status_code, found

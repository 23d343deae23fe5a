"""Posting a bundle to the FHIR server, and reading what it says of it."""

from __future__ import annotations

import ssl
import threading
import time

import httpx

from specimap_core.json_text import json_text
from specimap_hospital.fhir.elements import Element
from specimap_hospital.fhir.errors import FhirRefusedError, FhirUnavailableError
from specimap_infra.settings import ServiceSettings

TIMEOUT_SECONDS = 30.0
LARGEST_ANSWER = 4 * 1024**2
EARLY_SECONDS = 30.0
"""How long before its end a token is replaced."""
_MEDIA_TYPE = "application/fhir+json"
_PASSING = {401, 403, 404, 408, 409, 425, 429}
"""Answers that pass once the server, its rights or another transaction have been set right; and every 5xx."""
_ISSUES_SAID = 20


class FhirClient:
    """The configured FHIR server. Safe to share between threads.

    Error details hold codes alone: what a server says in words may repeat patient data.
    """

    def __init__(self, settings: ServiceSettings) -> None:
        self._settings = settings
        verify = ssl.create_default_context(cafile=settings.fhir_ca_file or None)
        # No proxy of the environment: the address is the whole of where data may go.
        self._http = httpx.Client(timeout=TIMEOUT_SECONDS, verify=verify, trust_env=False, follow_redirects=False)
        self._token, self._token_ends = "", 0.0
        self._lock = threading.Lock()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def post(self, bundle: Element) -> None:
        """Post a transaction.

        Raises:
            FhirRefusedError: the server refuses it, and would again. FhirUnavailableError: another try may succeed.
        """
        content = json_text(bundle).encode()
        answer = self._ask(self._settings.fhir_url, content, {"Content-Type": _MEDIA_TYPE, "Accept": _MEDIA_TYPE})
        if answer.status_code == 401:
            with self._lock:
                self._token_ends = 0.0
        if answer.is_success:
            _check_entries(answer)
            return
        issues = _issues(answer)
        if answer.status_code in _PASSING or answer.status_code >= 500:
            raise FhirUnavailableError(
                f"The FHIR server answers with {answer.status_code}.",
                advice="Check its address, and the rights of the token.",
                status=answer.status_code,
                issues=issues,
            )
        raise FhirRefusedError(
            f"The FHIR server refuses the result with {answer.status_code}.",
            advice="The issues' codes say why; the server's own log says more.",
            status=answer.status_code,
            issues=issues,
        )

    def _ask(self, url: str, content: bytes, headers: dict[str, str]) -> httpx.Response:
        token = self._bearer()
        if token:
            headers["Authorization"] = f"Bearer {token}"
        return self._bounded("POST", url, content=content, headers=headers)

    def _bounded(self, method: str, url: str, **options: object) -> httpx.Response:
        """Send a request and read at most so much of the answer."""
        try:
            with self._http.stream(method, url, **options) as answer:  # type: ignore[arg-type]
                body = b""
                for part in answer.iter_bytes():
                    body += part
                    if len(body) > LARGEST_ANSWER:
                        break
                headers = {"Content-Type": answer.headers.get("Content-Type", "")}
                return httpx.Response(answer.status_code, headers=headers, content=body)
        except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
            raise FhirUnavailableError(
                f"The FHIR server does not answer: {type(error).__name__}.",
                advice="Check SPECIMAP_FHIR_URL, its certificate and the network.",
            ) from error

    def _bearer(self) -> str:
        settings = self._settings
        if not settings.fhir_token_url:
            return settings.fhir_token.get_secret_value()
        with self._lock:
            if time.monotonic() < self._token_ends - EARLY_SECONDS:
                return self._token
            asked = time.monotonic()
            answer = self._bounded(
                "POST",
                settings.fhir_token_url,
                data={"grant_type": "client_credentials", "scope": "system/*.write"},
                auth=(settings.fhir_client_id, settings.fhir_client_secret.get_secret_value()),
            )
            given = _json(answer)
            token, seconds = given.get("access_token"), given.get("expires_in", 300)
            if not answer.is_success or not isinstance(token, str) or not isinstance(seconds, int | float):
                raise FhirUnavailableError(
                    f"The token server answers with {answer.status_code} and without a token.",
                    advice="Check SPECIMAP_FHIR_TOKEN_URL, and the client's id and secret.",
                    status=answer.status_code,
                )
            self._token, self._token_ends = token, asked + seconds
            return token


def _check_entries(answer: httpx.Response) -> None:
    """A transaction is done as a whole, but not every server keeps to that."""
    entries = _json(answer).get("entry")
    statuses = [
        str(entry.get("response", {}).get("status", ""))
        for entry in (entries if isinstance(entries, list) else [])
        if isinstance(entry, dict) and isinstance(entry.get("response", {}), dict)
    ]
    failed = sorted({status[:3] for status in statuses if not status.startswith("2")})
    if failed:
        raise FhirRefusedError(
            "The FHIR server took only a part of the result.",
            advice="It does not do transactions as a whole; see its own log.",
            status=answer.status_code,
            entries=failed,
        )


def _issues(answer: httpx.Response) -> list[str]:
    issues = _json(answer).get("issue")
    codes = [issue.get("code") for issue in (issues if isinstance(issues, list) else []) if isinstance(issue, dict)]
    # Codes of the standard are short words: anything else is not repeated.
    return [code for code in codes if isinstance(code, str) and code.isascii() and len(code) <= 20][:_ISSUES_SAID]


def _json(answer: httpx.Response) -> dict[str, object]:
    try:
        found = answer.json()
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}

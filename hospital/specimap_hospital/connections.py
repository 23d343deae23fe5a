"""Connections to a hospital's servers: DICOMweb and DICOM, encrypted and authenticated as the settings say.

The libraries log what they send and receive, and warn of values with the values in the text. All of that may be patient
data, so they are kept silent: what matters is said by this package, in its own words.
"""

from __future__ import annotations

import logging
import ssl
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

from specimap_core.errors import SettingsError
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    import requests
    from dicomweb_client.web import DICOMwebClient
    from pydantic import SecretStr
    from pynetdicom import AE
    from pynetdicom.association import Association

SILENT = ("pynetdicom", "pydicom", "dicomweb_client", "urllib3", "requests", "retrying", "highdicom")
LARGEST_ANSWER = 8 * 1024**2
"""Bytes of an answer to a question or to a STOW request."""
AWAY = frozenset(
    {"not_reachable", "no_answer", "tls_refused", "association_refused", "http_401", "http_403", "http_404", "http_429"}
)
_PIECE = 65536


class PeerError(Exception):
    """A server did not do what it was asked; ``reason`` is a code without any value of what was asked.

    ``passing``: it may do so later.
    """

    def __init__(self, reason: str, *, passing: bool = True) -> None:
        super().__init__(reason)
        self.reason = reason
        self.passing = passing

    @property
    def away(self) -> bool:
        """Whether the server answers nobody now, or not us, whatever it is asked."""
        return self.reason in AWAY or self.reason.startswith("http_5")


@cache
def quieten() -> None:
    """Keep the libraries from logging and warning of values; once in each process."""
    for name in SILENT:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    warnings.filterwarnings("ignore", module=r"(pydicom|pynetdicom|dicomweb_client)(\..*)?$")
    from pydicom import config
    from pynetdicom import _config

    config.settings.reading_validation_mode = config.IGNORE
    _config.LOG_HANDLER_LEVEL = "none"
    _config.LOG_REQUEST_IDENTIFIERS = _config.LOG_RESPONSE_IDENTIFIERS = False


def check_has_work(settings: ServiceSettings) -> None:
    """Raise SettingsError where a process of the hospital's side has nothing to do."""
    if not settings.has_hospital_process:
        raise SettingsError(
            "There is no archive, FHIR server or syslog server to send to, and no DICOM port.",
            advice="Set SPECIMAP_PACS_URL, _PACS_HOST, _FHIR_URL, _AUDIT_SYSLOG or _DICOM_PORT.",
            setting="pacs_url",
        )


def tls_context(settings: ServiceSettings) -> ssl.SSLContext:
    """Make the context of encrypted connections to the hospital's servers. Raises SettingsError for wrong files."""
    try:
        # The system's certificates, which may include a hospital's own authority, where none is named.
        context = ssl.create_default_context(cafile=settings.hospital_ca_file or None)
        if settings.hospital_cert_file:
            context.load_cert_chain(settings.hospital_cert_file, settings.hospital_key_file or None)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(
            "The certificates for the hospital's servers do not read.",
            advice="Name PEM files in SPECIMAP_HOSPITAL_CA_FILE, _CERT_FILE and _KEY_FILE.",
            setting="hospital_ca_file",
        ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


# ---- DICOMweb -----------------------------------------------------------------------------------------


def dicomweb(
    settings: ServiceSettings, url: str, *, token: SecretStr, user: str, password: SecretStr, seconds: float
) -> Any:
    """Make a client that connects to the host itself only: no proxy from the environment, no redirect, no repetition.

    An answer takes at most ``seconds``, and is at most 8 MiB long. Raises SettingsError.
    """
    quieten()
    import requests
    from dicomweb_client.web import DICOMwebClient
    from requests.adapters import HTTPAdapter
    from requests.auth import HTTPBasicAuth

    context = tls_context(settings) if url.startswith("https://") else None

    class Adapter(HTTPAdapter):
        def build_connection_pool_key_attributes(
            self, request: requests.PreparedRequest, verify: Any, cert: Any = None
        ) -> tuple[Any, Any]:
            # The library would add the authorities that it brings along.
            host, _ = super().build_connection_pool_key_attributes(request, verify, cert)
            return host, {} if context is None else {"ssl_context": context}

        def cert_verify(self, conn: Any, url: Any, verify: Any, cert: Any) -> None:
            """Nothing: the context does it."""

    session = requests.Session()
    session.trust_env = False
    session.max_redirects = 0
    session.mount("https://", Adapter())
    if bearer := token.get_secret_value():
        session.headers["Authorization"] = f"Bearer {bearer}"
    elif user:
        session.auth = HTTPBasicAuth(user.encode(), password.get_secret_value().encode())
    client: DICOMwebClient = DICOMwebClient(
        url, session=session, callback=_bounded(seconds), chunk_size=2**31 - 1, timeout=(min(seconds, 10.0), seconds)
    )
    client.set_http_retry_params(retry=False)
    return client


def _bounded(seconds: float) -> Any:
    def read(response: requests.Response, *_: object, **__: object) -> requests.Response:
        content, end = bytearray(), time.monotonic() + seconds
        for piece in response.iter_content(_PIECE):
            content += piece
            if len(content) > LARGEST_ANSWER or time.monotonic() > end:
                response.close()
                raise PeerError("answer_too_long")
        response._content = bytes(content)
        return response

    return read


@contextmanager
def web_errors() -> Iterator[None]:
    """Raise what goes wrong with a DICOMweb server as PeerError, without its text: addresses hold what was asked."""
    import requests

    try:
        yield
    except PeerError:
        raise
    except requests.HTTPError as error:
        status = 0 if error.response is None else error.response.status_code
        passing = status in (0, 401, 403, 404, 408, 409, 425, 429) or status >= 500
        raise PeerError(f"http_{status}", passing=passing) from None
    except requests.exceptions.SSLError:
        raise PeerError("tls_refused") from None
    except requests.Timeout:
        raise PeerError("no_answer") from None
    except requests.RequestException:
        raise PeerError("not_reachable") from None
    except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError):
        raise PeerError("answer_unreadable") from None


# ---- DICOM --------------------------------------------------------------------------------------------


def entity(settings: ServiceSettings, seconds: float) -> AE:
    """Make an application entity whose waits take at most ``seconds`` each."""
    quieten()
    from pynetdicom import AE

    made = AE(ae_title=settings.ae_title or "SPECIMAP")
    made.acse_timeout = made.dimse_timeout = made.network_timeout = seconds
    made.connection_timeout = min(seconds, 10.0)
    return made


@contextmanager
def association(
    ae: AE, settings: ServiceSettings, host: str, port: int, title: str, *, tls: bool, **options: Any
) -> Iterator[Association]:
    """Associate with a DICOM server for the time of the block.

    Raises:
        PeerError: it does not answer, or refuses. SettingsError: the certificates do not read.
    """
    arguments = (tls_context(settings), host) if tls else None
    try:
        found = ae.associate(host, port, ae_title=title or "ANY-SCP", tls_args=arguments, **options)
    except (OSError, RuntimeError, ValueError):
        raise PeerError("not_reachable") from None
    if not found.is_established:
        raise PeerError("association_refused" if found.is_rejected else "not_reachable")
    try:
        yield found
    finally:
        _end(found)


def _end(peer: Association) -> None:
    if peer.is_established:
        peer.release()
    else:
        peer.abort()

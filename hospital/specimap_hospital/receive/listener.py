"""The DICOM port: C-ECHO, C-STORE, and the archive's reports of its commitment. Off unless a port is set.

Only peers whose application entity title is named are heard. A title is no proof of who asks, so the port belongs on an
inner network, or behind TLS with client certificates.
"""

from __future__ import annotations

import ssl
import threading
from collections.abc import Callable
from io import BytesIO
from typing import Any

from specimap_core.errors import SettingsError
from specimap_hospital.connections import entity
from specimap_hospital.outbox.commitment import MODEL, take_report
from specimap_hospital.receive.classes import CANNOT_UNDERSTAND, JPEG, PHOTOS, PLAIN, SEGMENTATIONS
from specimap_hospital.receive.forward import forwarded
from specimap_infra.database import Database, utc_now
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings

VERIFICATION = "1.2.840.10008.1.1"
MOST_ASSOCIATIONS = 64
IDLE_SECONDS = 30.0
GREETING_SECONDS = 5.0
RETRY_SECONDS = 5.0
FAILED = 0x0110
SUCCESS = 0x0000
_COUNTED = "specimap_counted_bytes"


def start_listener(database: Database, settings: ServiceSettings) -> Callable[[], None]:
    """Listen in threads; a port that is taken is tried again. Returns what ends it.

    Raises:
        SettingsError: the certificate does not read.
    """
    titles = [title for title in (*settings.dicom_peers, settings.pacs_ae_title) if title]
    if not titles:
        # An empty list would let everybody in.
        logger().warning("dicom port stays closed: no title may use it", port=settings.dicom_port)
        return lambda: None
    ae = entity(settings, IDLE_SECONDS)
    from pynetdicom import evt

    ae.maximum_associations = MOST_ASSOCIATIONS
    # Who connects says soon what for: silent connections take the places of others.
    ae.acse_timeout = GREETING_SECONDS
    ae.require_called_aet = True
    ae.require_calling_aet = titles
    ae.add_supported_context(VERIFICATION)
    if settings.dicom_key.get_secret_value():
        for sop_class in SEGMENTATIONS:
            ae.add_supported_context(sop_class, list(PLAIN))
        for sop_class in PHOTOS:
            ae.add_supported_context(sop_class, [*PLAIN, JPEG])
    # The archive reports as what it is, the provider of the commitment.
    ae.add_supported_context(MODEL, scu_role=False, scp_role=True)
    handlers: list[Any] = [
        (evt.EVT_C_ECHO, lambda event: SUCCESS),
        (evt.EVT_C_STORE, lambda event: _taken(settings, event)),
        (evt.EVT_PDU_RECV, lambda event: _bound(settings, event)),
        (evt.EVT_DIMSE_RECV, lambda event: setattr(event.assoc, _COUNTED, 0)),
        (evt.EVT_REJECTED, lambda event: logger().warning("dicom peer rejected", port=settings.dicom_port)),
        (evt.EVT_N_EVENT_REPORT, lambda event: (_report(database, event), None)),
    ]
    context = _server_tls(settings)
    ended, servers = threading.Event(), []

    def listen() -> None:
        while not ended.is_set():
            try:
                made = ae.start_server(
                    (settings.dicom_host, settings.dicom_port), block=False, evt_handlers=handlers, ssl_context=context
                )
            except OSError as error:
                logger().error("dicom port not listened on", port=settings.dicom_port, error=error.strerror)
                ended.wait(RETRY_SECONDS)
            else:
                assert made is not None
                servers.append(made)
                logger().info("dicom port", host=settings.dicom_host, port=settings.dicom_port)
                return

    thread = threading.Thread(target=listen, name="dicom port", daemon=True)
    thread.start()

    def stop() -> None:
        ended.set()
        thread.join(timeout=10)
        for server in servers:
            server.shutdown()

    return stop


def _bound(settings: ServiceSettings, event: Any) -> None:
    """End an association that sends more in one message than an object may have."""
    from pynetdicom.pdu import P_DATA_TF

    if isinstance(event.pdu, P_DATA_TF):
        counted = getattr(event.assoc, _COUNTED, 0) + event.pdu.pdu_length
        setattr(event.assoc, _COUNTED, counted)
        if counted > settings.most_dicom_bytes:
            logger().warning("dicom object too large", limit_bytes=settings.most_dicom_bytes)
            event.assoc.abort()


def _taken(settings: ServiceSettings, event: Any) -> int:
    from pydicom import dcmread

    try:
        # As a file has it: the data set alone would be handed on without its head.
        return forwarded(settings, dcmread(BytesIO(event.encoded_dataset())))
    except Exception as error:
        # Without its text, which may hold a value.
        logger().warning("dicom object not read", error=type(error).__name__)
        return CANNOT_UNDERSTAND


def _report(database: Database, event: Any) -> int:
    try:
        known = take_report(database, event.event_information, utc_now)
    except Exception as error:
        # Without its text, which may hold a value; the archive tries again, or is asked again.
        logger().warning("commitment not read", error=type(error).__name__)
        return FAILED
    return SUCCESS if known else FAILED


def _server_tls(settings: ServiceSettings) -> ssl.SSLContext | None:
    if settings.dicom_tls == "off":
        return None
    try:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=settings.hospital_ca_file or None)
        context.load_cert_chain(settings.hospital_cert_file, settings.hospital_key_file or None)
    except (OSError, ssl.SSLError) as error:
        raise SettingsError(
            "The certificate for the DICOM port does not read.",
            advice="Name PEM files in SPECIMAP_HOSPITAL_CERT_FILE and SPECIMAP_HOSPITAL_KEY_FILE.",
            setting="hospital_cert_file",
        ) from error
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    # Who connects shows a certificate of the hospital's authority.
    context.verify_mode = ssl.CERT_REQUIRED
    return context

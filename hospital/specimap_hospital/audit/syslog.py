"""Syslog: messages of RFC 5424 over TLS (RFC 5425), TCP with octet counting (RFC 6587) or UDP (RFC 5426).

No kept library tells whether a message was delivered: the logging handlers of PyPI swallow what goes wrong. The framing
is two lines, so it stands here.

Syslog has no acknowledgement. What comes closest: after a batch the connection is closed for sending, and the server's
own end of the connection is waited for. It comes only once the server has read everything; a server that dies before
resets the connection. Over UDP nothing is known.
"""

from __future__ import annotations

import datetime
import os
import re
import socket
import ssl
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from specimap_core.errors import SettingsError
from specimap_infra.errors import SyslogUnavailableError

PRIORITY = 10 * 8 + 5
"""Facility 10, security and authorization messages; severity 5, notice: as PS3.15 A.6 asks for."""
TIMEOUT_SECONDS = 10.0
DATAGRAM_BYTES = 60_000


@dataclass(frozen=True)
class Message:
    """A message and when it happened; ``kind`` is its MSGID."""

    at: datetime.datetime
    kind: str
    text: str

    def framed(self, host: str) -> bytes:
        """Return the message as RFC 5424 has it, without a frame."""
        at = self.at.astimezone(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        header = f"<{PRIORITY}>1 {at} {host} specimap {os.getpid()} {self.kind} - "
        # The mark says that the text is UTF-8.
        return header.encode("ascii") + b"\xef\xbb\xbf" + self.text.encode()


@dataclass(frozen=True)
class Server:
    """A syslog server, by an address such as ``tls://host:6514``."""

    address: str
    ca: Path | None = None
    certificate: Path | None = None

    @property
    def _parts(self) -> tuple[str, str, int]:
        scheme, _, rest = self.address.partition("://")
        host, _, port = rest.rpartition(":")
        return scheme, host.strip("[]"), int(port)

    def send(self, messages: Sequence[Message]) -> None:
        """Send a batch, and wait until the server has read it.

        Raises:
            SyslogUnavailableError: it may not have; all of the batch is to be sent again.
            SettingsError: a certificate file cannot be read.
        """
        scheme, host, port = self._parts
        own = re.sub(r"[^\x21-\x7e]", "-", socket.gethostname())[:255] or "-"
        try:
            if scheme == "udp":
                self._send_datagrams(host, port, [message.framed(own) for message in messages])
                return
            frames = [message.framed(own) for message in messages]
            payload = b"".join(b"%d %s" % (len(frame), frame) for frame in frames)
            context = self._context() if scheme == "tls" else None
            with socket.create_connection((host, port), timeout=TIMEOUT_SECONDS) as plain:
                if context is None:
                    plain.sendall(payload)
                    plain.shutdown(socket.SHUT_WR)
                    _read_to_end(plain)
                    return
                with context.wrap_socket(plain, server_hostname=host) as secure:
                    secure.sendall(payload)
                    _end_tls(secure)
        except OSError as error:
            raise SyslogUnavailableError(
                f"The syslog server did not take the audit trail ({type(error).__name__}).",
                advice="Look at SPECIMAP_AUDIT_SYSLOG and at the server; it is tried again.",
            ) from error

    def _send_datagrams(self, host: str, port: int, frames: Sequence[bytes]) -> None:
        family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as datagrams:
            for frame in frames:
                datagrams.sendto(frame[:DATAGRAM_BYTES], where)

    def _context(self) -> ssl.SSLContext:
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.certificate is not None:
                context.load_cert_chain(self.certificate)
        except (OSError, ssl.SSLError) as error:
            raise SettingsError(
                f"A certificate for the syslog server cannot be read ({type(error).__name__}).",
                advice="Correct SPECIMAP_AUDIT_SYSLOG_CA or SPECIMAP_AUDIT_SYSLOG_CERTIFICATE.",
                setting="audit_syslog_ca",
            ) from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context


def _read_to_end(connection: socket.socket) -> None:
    while connection.recv(4096):
        pass


def _end_tls(secure: ssl.SSLSocket) -> None:
    """Say that nothing more comes, and wait for the server's end."""
    # Rsyslog's driver for GnuTLS ends the connection without saying so in TLS. It is an end all the same: a server that
    # dies with bytes unread resets the connection. Whoever forges it on the way hides a batch, which `seq` then shows.
    with suppress(ssl.SSLEOFError):
        secure.unwrap()

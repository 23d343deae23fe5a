"""A real rsyslog with certificates of its own, which writes what it receives to a file."""

from __future__ import annotations

import datetime
import ipaddress
import shutil
import socket
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

MODULES = Path("/usr/lib/x86_64-linux-gnu/rsyslog")


def _certificate(
    name: str, issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer[0].subject if issuer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    signer = issuer[1] if issuer else key
    builder = builder.add_extension(
        x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False
    )
    if issuer:
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    else:
        usage = dict.fromkeys(
            ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement"), False
        )
        usage |= {"key_cert_sign": True, "crl_sign": True, "encipher_only": False, "decipher_only": False}
        builder = builder.add_extension(x509.KeyUsage(**usage), critical=True)
    return builder.sign(signer, hashes.SHA256()), key


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Rsyslog:
    """A server that can be stopped and started again. ``kind``: tls, tcp or udp; ``driver``: ossl or gtls."""

    folder: Path
    kind: str
    driver: str = "ossl"
    port: int = 0
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        assert shutil.which("rsyslogd"), "rsyslog is not installed: .ci/run installs it"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.port = _free_port(socket.SOCK_DGRAM if self.kind == "udp" else socket.SOCK_STREAM)
        authority = _certificate("test authority", None)
        certificate, key = _certificate("localhost", authority)
        pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
        self.ca.write_bytes(authority[0].public_bytes(pem))
        (self.folder / "server.pem").write_bytes(certificate.public_bytes(pem))
        (self.folder / "server.key").write_bytes(
            key.private_bytes(pem, serialization.PrivateFormat.TraditionalOpenSSL, plain)
        )
        (self.folder / "rsyslog.conf").write_text(self._configuration())

    @property
    def ca(self) -> Path:
        """The authority that signed its certificate."""
        return self.folder / "ca.pem"

    @property
    def address(self) -> str:
        """For ``SPECIMAP_AUDIT_SYSLOG``."""
        return f"{self.kind}://127.0.0.1:{self.port}"

    def _configuration(self) -> str:
        if self.kind == "udp":
            receives = f'module(load="imudp")\ninput(type="imudp" address="127.0.0.1" port="{self.port}" ruleset="r")'
        else:
            tls = f'StreamDriver.Name="{self.driver}" StreamDriver.Mode="1" StreamDriver.AuthMode="anon"'
            receives = (
                f'module(load="imtcp" {tls if self.kind == "tls" else ""})\n'
                f'input(type="imtcp" address="127.0.0.1" port="{self.port}" ruleset="r")'
            )
        return f"""global(workDirectory="{self.folder}" maxMessageSize="64k"
DefaultNetstreamDriverCAFile="{self.ca}"
DefaultNetstreamDriverCertFile="{self.folder}/server.pem" DefaultNetstreamDriverKeyFile="{self.folder}/server.key")
template(name="t" type="string" string="%pri% %app-name% %msgid% %msg%\\n")
ruleset(name="r") {{ action(type="omfile" file="{self.folder}/received" template="t") }}
{receives}
"""

    def start(self) -> None:
        """Start it, and wait until it listens."""
        command = ["rsyslogd", "-n", "-f", str(self.folder / "rsyslog.conf"), "-i", str(self.folder / "pid")]
        with open(self.folder / "log", "ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log)
        deadline = time.monotonic() + 20
        while not self._listens():
            assert self.process.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < deadline, "rsyslog did not start"
            time.sleep(0.05)

    def _listens(self) -> bool:
        table = "udp" if self.kind == "udp" else "tcp"
        wanted = f"0100007F:{self.port:04X}"
        return any(wanted in line.split()[1] for line in Path(f"/proc/net/{table}").read_text().splitlines())

    def stop(self) -> None:
        """End it; what it has received is on the disk then."""
        if self.process is not None:
            self.process.terminate()
            self.process.wait(20)
            self.process = None

    def received(self) -> list[str]:
        """Lines that it has written: priority, program, MSGID, message."""
        file = self.folder / "received"
        return file.read_text("utf-8").splitlines() if file.exists() else []

    def wait_for(self, count: int) -> list[str]:
        """The lines, once there are as many."""
        deadline = time.monotonic() + 20
        while len(found := self.received()) < count and time.monotonic() < deadline:
            time.sleep(0.05)
        return found

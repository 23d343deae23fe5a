"""docker/proxy/Caddyfile, run by Caddy itself before two small servers that stand for the replicas."""

from __future__ import annotations

import asyncio
import datetime
import ipaddress
import os
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fastapi import FastAPI, Request, Response
from fastapi.responses import StreamingResponse

from tests.support.places import ROOT

CADDY = shutil.which("caddy", path=str(Path(sys.executable).parent)) or shutil.which("caddy")
PIECE = b"x" * 65_536
FORM = "/v1/acquisitions/acq_1/files"

pytestmark = pytest.mark.skipif(CADDY is None, reason="there is no caddy; it comes with the extra dev")


@dataclass
class Replica:
    """A server that tells its name and what has reached it so far."""

    name: str
    began: threading.Event = field(default_factory=threading.Event)
    seen: threading.Event = field(default_factory=threading.Event)
    encodings: list[str | None] = field(default_factory=list)

    def app(self) -> FastAPI:
        app = FastAPI()

        @app.get("/healthz")
        def healthz() -> str:
            return "ok"

        @app.get("/name/{rest:path}")
        def name(rest: str) -> str:
            return self.name

        @app.post("/{path:path}")
        async def upload(request: Request) -> dict[str, int]:
            size = 0
            async for piece in request.stream():
                size += len(piece)
                self.began.set()
            return {"size": size}

        @app.get("/events")
        def events() -> StreamingResponse:
            async def stream() -> AsyncIterator[str]:
                yield "id: 1\ndata: first\n\n"
                yield f"data: {await asyncio.to_thread(self.seen.wait, 20)}\n\n"

            return StreamingResponse(stream(), media_type="text/event-stream")

        @app.get("/chunk")
        def chunk(request: Request) -> Response:
            self.encodings.append(request.headers.get("accept-encoding"))
            headers = {"ETag": '"abc"', "Content-Range": "bytes 0-65535/70000", "Accept-Ranges": "bytes"}
            return Response(PIECE, 206, headers, "application/octet-stream")

        return app


@contextmanager
def replica(name: str) -> Iterator[tuple[Replica, int]]:
    made = Replica(name)
    server = uvicorn.Server(uvicorn.Config(made.app(), port=0, log_config=None, access_log=False, ws="none"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    wait_until(lambda: server.started)
    try:
        yield made, server.servers[0].sockets[0].getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(timeout=20)


def wait_until(holds: object, seconds: float = 20) -> None:
    deadline = time.monotonic() + seconds
    while not holds():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def certificate(folder: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    names: list[x509.GeneralName] = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / "tls.key").write_bytes(private)
    (folder / "tls.crt").write_bytes(made.public_bytes(serialization.Encoding.PEM))


@dataclass
class Proxy:
    """Caddy before two replicas."""

    client: httpx.Client
    replicas: list[Replica]
    stack: list[ExitStack]
    log: Path

    def name(self, key: str, path: str = "") -> str:
        answer = self.client.get(f"/name/{path}", headers={"Authorization": f"Bearer {key}"})
        assert answer.status_code == 200
        return str(answer.json())


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Proxy]:
    certificate(tmp_path)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    stacks = [ExitStack(), ExitStack()]
    made = [stack.enter_context(replica(name)) for stack, name in zip(stacks, "ab", strict=True)]
    environment = {
        **{name: value for name, value in os.environ.items() if "proxy" not in name.lower()},
        "PUBLIC_HOST": "localhost",
        "HTTPS_PORT": str(port),
        "UPSTREAMS": " ".join(f"127.0.0.1:{at}" for _, at in made),
        "TLS_CERT": str(tmp_path / "tls.crt"),
        "TLS_KEY": str(tmp_path / "tls.key"),
        "HOME": str(tmp_path),
        "XDG_DATA_HOME": str(tmp_path),
        "XDG_CONFIG_HOME": str(tmp_path),
    }
    log = tmp_path / "caddy.log"
    context = ssl.create_default_context(cafile=str(tmp_path / "tls.crt"))
    with open(log, "wb") as output:
        caddy = subprocess.Popen(
            [str(CADDY), "run", "--adapter", "caddyfile", "--config", str(ROOT / "docker" / "proxy" / "Caddyfile")],
            env=environment,
            stderr=output,
        )
    try:
        with httpx.Client(base_url=f"https://localhost:{port}", verify=context, timeout=30, trust_env=False) as client:

            def answers() -> bool:
                assert caddy.poll() is None, log.read_text("utf-8")
                try:
                    return client.get("/healthz").status_code == 200
                except httpx.TransportError:
                    return False

            wait_until(answers)
            yield Proxy(client, [one for one, _ in made], stacks, log)
    finally:
        caddy.terminate()
        caddy.wait(40)
        for stack in stacks:
            stack.close()


def test_a_key_stays_with_one_replica_and_keys_share_the_replicas(proxy: Proxy) -> None:
    names = {}
    for at in range(16):
        of_key = {proxy.name(f"spk_{at}", f"v1/uploads/{path}") for path in range(4)}
        assert len(of_key) == 1
        names[at] = of_key.pop()
    assert set(names.values()) == {"a", "b"}


@pytest.mark.slow
def test_requests_go_on_without_one_replica_and_no_key_is_logged(proxy: Proxy) -> None:
    first = proxy.name("spk_secret")
    gone = [one.name for one in proxy.replicas].index(first)
    proxy.stack[gone].close()
    assert proxy.name("spk_secret", "patients-name.jpg") != first
    proxy.stack[1 - gone].close()
    answer = proxy.client.get("/name/patients-name.jpg", headers={"Authorization": "Bearer spk_secret"})
    assert answer.status_code in (502, 503)
    log = proxy.log.read_text("utf-8")
    assert '"level":"error"' in log
    assert "spk_secret" not in log
    assert "patients-name" not in log


def test_a_body_reaches_the_service_while_it_is_still_being_sent(proxy: Proxy) -> None:
    def body() -> Iterator[bytes]:
        yield PIECE
        wait_until(lambda: any(one.began.is_set() for one in proxy.replicas))
        for _ in range(160):
            yield PIECE

    answer = proxy.client.post(FORM, content=body(), headers={"Authorization": "Bearer spk_1"})
    assert answer.json() == {"size": 161 * len(PIECE)}


def test_an_event_reaches_the_client_before_the_next_is_sent(proxy: Proxy) -> None:
    with proxy.client.stream("GET", "/events") as answer:
        lines = answer.iter_lines()
        assert [next(lines), next(lines)] == ["id: 1", "data: first"]
        for one in proxy.replicas:
            one.seen.set()
        assert "data: True" in list(lines)


def test_answers_pass_unchanged_and_say_that_tls_is_a_must(proxy: Proxy) -> None:
    answer = proxy.client.get("/chunk", headers={"Accept-Encoding": "gzip, br, zstd"})
    assert (answer.status_code, answer.content) == (206, PIECE)
    assert answer.headers["ETag"] == '"abc"'
    assert answer.headers["Content-Range"] == "bytes 0-65535/70000"
    assert answer.headers["Content-Length"] == str(len(PIECE))
    assert "Content-Encoding" not in answer.headers
    assert answer.headers["Strict-Transport-Security"] == "max-age=31536000"
    assert "Server" not in answer.headers
    assert "Via" not in answer.headers
    # A client that asks for no compression reaches the service as one.
    plain = proxy.client.get("/chunk", headers={"Accept-Encoding": "identity"})
    assert plain.content == PIECE
    assert "identity" in {encoding for one in proxy.replicas for encoding in one.encodings}


def test_the_file_is_formatted_as_caddy_does(tmp_path: Path) -> None:
    done = subprocess.run(
        [str(CADDY), "fmt", "--diff", str(ROOT / "docker" / "proxy" / "Caddyfile")],
        capture_output=True,
        text=True,
        timeout=30,
        env={**os.environ, "HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("path", "digits"),
    [("/v1/jobs", 7), ("/v1/clouds/cloud_1/spectra", 8), ("/v1/clouds/cloud_1/labels/a/b", 7), (FORM, 11)],
)
def test_bodies_beyond_all_measure_reach_no_replica(proxy: Proxy, path: str, digits: int) -> None:
    with socket.create_connection((proxy.client.base_url.host, proxy.client.base_url.port or 443), timeout=20) as bare:
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        with context.wrap_socket(bare, server_hostname="localhost") as connection:
            lines = [f"POST {path} HTTP/1.1", f"Host: {proxy.client.base_url.netloc.decode()}"]
            lines.append(f"Content-Length: {'1' + '0' * (digits - 1)}")
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            # Caddy takes up to 256 KiB of a body that it does not want before it answers.
            connection.sendall(b"x" * 300_000)
            assert connection.recv(1000).split()[1] == b"413"
    assert not any(one.began.is_set() for one in proxy.replicas)
    body = b"x" * min(10 ** (digits - 1) - 1, 10**7)
    answer = proxy.client.post(path, content=body, headers={"Authorization": "Bearer spk_1"})
    assert answer.json() == {"size": len(body)}


def test_limits_of_the_proxy_are_wider_than_those_of_the_api() -> None:
    """Where both refuse, the API says why."""
    from specimap_infra.settings import load_settings
    from specimap_service.body_limits import LARGEST_JSON, LARGEST_SELECTION

    assert LARGEST_JSON < 10**6
    assert LARGEST_SELECTION < 10**7
    assert load_settings().max_cube_bytes < 10**10

"""Canaille, an identity provider with pages of its own, in an environment of its own: started for tests on loopback."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.support.places import ROOT

VARIABLE = "CANAILLE_HOME"
"""Names the environment in which Canaille is installed."""
CLIENT_ID, CLIENT_SECRET = "specimap", "a secret of the client"
PASSWORD = "correct horse battery staple"
START_SECONDS = 60.0
COMMAND_SECONDS = 120.0


@dataclass(frozen=True)
class Canaille:
    """A running server."""

    issuer: str
    environment: Mapping[str, str]
    program: Path

    def run(self, *arguments: str) -> str:
        """Run one of its commands; return what it prints."""
        done = subprocess.run(
            [self.program, *arguments],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=COMMAND_SECONDS,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    def add_user(self, name: str, *groups: str) -> None:
        """Add an account with the password of all, in new groups."""
        self.run(
            *("create", "user", "--user-name", name, "--password", PASSWORD, "--emails", f"{name}@example.test"),
            *("--given-name", "Jane", "--family-name", "Doe", "--formatted-name", "Doe^Jane"),
        )
        for group in groups:
            self.run("create", "group", "--display-name", group, "--members", name)

    def add_client(self, url: str) -> None:
        """Make a service at ``url`` known."""
        self.run(
            *("create", "client", "--client-id", CLIENT_ID, "--client-secret", CLIENT_SECRET),
            *("--client-name", "Specimap", "--client-uri", url, "--redirect-uris", f"{url}/v1/sso/callback"),
            *("--post-logout-redirect-uris", f"{url}/", "--grant-types", "authorization_code"),
            *("--response-types", "code", "--token-endpoint-auth-method", "client_secret_basic"),
            *("--id-token-signed-response-alg", "RS256"),
            *("--scope", "openid", "--scope", "profile", "--scope", "groups"),
        )
        # A client's tokens are for nobody unless it says for whom.
        self.run("set", "client", CLIENT_ID, "--audience", CLIENT_ID)


def home() -> Path:
    """The environment with Canaille; skips where there is none, and says how to get one."""
    found = Path(os.environ.get(VARIABLE) or ROOT / ".venv-canaille")
    if not (found / "bin" / "canaille").is_file():
        pytest.skip(f"there is no Canaille: make identity-provider, or name its environment in {VARIABLE}")
    return found


@contextmanager
def canaille_running(folder: Path, port: int) -> Iterator[Canaille]:
    """Run a server with an empty database until the block ends."""
    program = home() / "bin" / "canaille"
    configuration = folder / "canaille.toml"
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    environment |= {"CANAILLE_CONFIG": str(configuration), "AUTHLIB_INSECURE_TRANSPORT": "1"}
    server = Canaille(f"http://127.0.0.1:{port}", environment, program)
    text = f"""\
SECRET_KEY = "for tests"
SERVER_NAME = "127.0.0.1:{port}"
PREFERRED_URL_SCHEME = "http"
SESSION_COOKIE_SECURE = false

[CANAILLE]
DATABASE = "sql"

[CANAILLE_SQL]
DATABASE_URI = "sqlite:///{folder / "canaille.sqlite"}"

[CANAILLE_OIDC]
"""
    configuration.write_text(text, "utf-8")
    key = server.run("jwk", "create", "rsa", "--format", "toml").strip().splitlines()[-1]
    configuration.write_text(f"{text}ACTIVE_JWKS = [{key}]\n", "utf-8")
    server.run("install")
    log = folder / "canaille.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [program, "run", "--bind", f"127.0.0.1:{port}"], env=environment, stdout=output, stderr=output
        )
        try:
            _wait(server.issuer, process, log)
            yield server
        finally:
            process.terminate()
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(timeout=15)


def _wait(issuer: str, process: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        assert process.poll() is None, log.read_text("utf-8", "replace")[-2000:]
        try:
            if httpx.get(f"{issuer}/.well-known/openid-configuration", trust_env=False, timeout=5).status_code == 200:
                return
        except httpx.HTTPError:
            time.sleep(0.2)
    raise AssertionError(f"Canaille did not start: {log.read_text('utf-8', 'replace')[-2000:]}")

"""panva's oidc-provider, a certified implementation for Node, started for tests on loopback."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from joserfc.jwk import ECKey

from tests.support.identity_provider import AUDIENCE, CLIENT_ID, CLIENT_SECRET
from tests.support.places import ROOT, SUPPORT

FOLDER = SUPPORT / "oidc_provider"
ALGORITHM = "ES256"


def node() -> Path:
    """The machine's Node; skips where there is none, or the library is not installed, and says how to get them."""
    found = shutil.which("node", path=f"{ROOT / '.venv' / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}")
    if found is None or not (FOLDER / "node_modules" / "oidc-provider").is_dir():
        pytest.skip("there is no oidc-provider: make identity-provider")
    return Path(found)


@contextmanager
def certified_provider(port: int, public_url: str, keys: Sequence[ECKey]) -> Iterator[str]:
    """Run a provider that signs with the first key, for a service at ``public_url``; yield its issuer.

    An account has the role of its name; a program's token has the role classifier. Any password will do.
    """
    settings = {
        "jwks": {"keys": [key.as_dict(private=True) for key in keys]},
        "algorithm": ALGORITHM,
        "client_id": CLIENT_ID,
        "client_secret": CLIENT_SECRET,
        "redirect_uri": f"{public_url}/v1/sso/callback",
        "post_logout_redirect_uri": f"{public_url}/",
        "audience": AUDIENCE,
    }
    command: list[str | Path] = [node(), FOLDER / "server.mjs", str(port), json.dumps(settings)]
    # In a session of its own: what npm packages call node may be a program that starts the real one.
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        try:
            said = []
            # It ends by itself where it cannot listen.
            for line in process.stdout:
                said.append(line)
                if line.startswith("listening"):
                    break
            else:
                raise AssertionError("".join(said))
            yield f"http://127.0.0.1:{port}"
        finally:
            os.killpg(process.pid, signal.SIGKILL)

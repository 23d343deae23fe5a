"""Access tokens of a certified provider: whose keys change while the service runs."""

from __future__ import annotations

import socket
from pathlib import Path

import httpx
import pytest
from joserfc.jwk import ECKey

from specimap_service.auth.oidc.provider import AGAIN_SECONDS
from tests.support.certified_provider import certified_provider
from tests.support.identity_provider import AUDIENCE, CLIENT_ID, CLIENT_SECRET, ROLES
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def key(name: str) -> ECKey:
    return ECKey.generate_key("P-256", {"kid": name, "use": "sig", "alg": "ES256"})


def token_of(issuer: str, audience: str = AUDIENCE) -> str:
    answer = httpx.post(
        f"{issuer}/token",
        data={"grant_type": "client_credentials", "resource": audience},
        auth=(CLIENT_ID, CLIENT_SECRET),
        trust_env=False,
        timeout=30,
    )
    assert answer.status_code == 200, answer.text
    return str(answer.json()["access_token"])


def asked(service: Running, token: str) -> httpx.Response:
    headers = {"Authorization": f"Bearer {token}"}
    return httpx.get(f"{service.url}/v1/session", headers=headers, trust_env=False, verify=NO_TLS, timeout=30)


@pytest.mark.slow
def test_tokens_count_across_a_change_of_keys_and_a_restart_of_the_provider(tmp_path: Path) -> None:
    port, public_url = free_port(), "http://127.0.0.1:1"
    first, second = key("first"), key("second")
    settings = {
        "oidc_issuer": f"http://127.0.0.1:{port}",
        "oidc_client_id": CLIENT_ID,
        "oidc_audience": AUDIENCE,
        "oidc_roles": ROLES,
        "public_url": public_url,
    }
    with serving(tmp_path, **settings) as service:  # type: ignore[arg-type]
        with certified_provider(port, public_url, [first]) as issuer:
            before = token_of(issuer)
            told = asked(service, before).json()
            assert (told["roles"], told["scopes"]) == (["classifier"], ["read", "label"])
            refused = asked(service, token_of(issuer, "https://another.test/api"))
            assert (refused.status_code, refused.json()["details"]) == (401, {"reason": "audience"})
        # It is away; what it signed counts on.
        service.app.state.keyring.forget()
        assert asked(service, before).status_code == 200
        with certified_provider(port, public_url, [second, first]) as issuer:
            known = service.app.state.identity.provider
            known._tried -= AGAIN_SECONDS
            after = asked(service, token_of(issuer)).json()
            assert after["key_id"] == told["key_id"]
            assert asked(service, before).status_code == 200
        with certified_provider(port, public_url, [second]):
            known._known = None
            known._tried = None
            service.app.state.keyring.forget()
            gone = asked(service, before)
            assert (gone.status_code, gone.json()["details"]) == (401, {"reason": "unknown_key"})

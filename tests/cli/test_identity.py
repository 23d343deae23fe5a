"""``specimap identity``: the check against a provider, and the people who are blocked and let in again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from specimap_infra.tables import AuditEntry
from specimap_service.auth.people import known_person
from tests.support.backup_scene import PROGRAM
from tests.support.identity_provider import Provider, provider_running
from tests.support.service_scene import serving


def specimap(settings: dict[str, Any], *arguments: str, given: str = "") -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")}
    for name, value in settings.items():
        environment[f"SPECIMAP_{name.upper()}"] = json.dumps(value) if isinstance(value, dict) else str(value)
    command = [sys.executable, "-W", "error", "-c", PROGRAM, "identity", *arguments]
    return subprocess.run(
        command, env=environment, input=given, capture_output=True, text=True, timeout=120, check=False
    )


def found(provider: Provider, *arguments: str, given: str = "", **more: Any) -> tuple[int, dict[str, list[Any]]]:
    settings = provider.settings("https://specimap.hospital.example", **more)
    done = specimap(settings, "check", "--json", *arguments, given=given)
    findings: dict[str, list[Any]] = {}
    for line in done.stdout.splitlines():
        told = json.loads(line)
        findings.setdefault(told["what"], []).append((told["fine"], told["told"]))
    return done.returncode, findings


def test_check_tells_what_works_and_what_a_token_gives() -> None:
    with provider_running() as provider:
        code, findings = found(provider, "--token", given=provider.token(roles=["specimap-auditor", "secret-group"]))
        assert code == 0
        assert findings["provider"] == [(True, provider.issuer)]
        assert findings["redirect"][0][1].startswith("register https://specimap.hospital.example/v1/sso/callback")
        assert findings["token"][0][0] is True
        assert findings["roles"][1] == (True, "auditor")
        assert "secret-group" not in str(findings)
        assert "alice" not in str(findings)

        code, findings = found(provider, "--token", given=provider.token(aud="another"))
        assert (code, findings["token"][0][0]) == (1, False)
        code, findings = found(provider, "--token", given=provider.token(), oidc_roles_claim="realm_access.roles")
        assert code == 1
        assert findings["claim"][0][1].startswith("there is no realm_access.roles; there are aud, ")
        provider.metadata = {"issuer": "https://another.test"}
        code, findings = found(provider)
        assert (code, list(findings), findings["provider"][0][0]) == (1, ["provider"], False)


def test_check_without_a_provider_says_what_to_set() -> None:
    done = specimap({}, "check")
    assert done.returncode == 2
    assert "docs/identity.md" in done.stderr + done.stdout


def test_people_are_blocked_and_let_in_again(tmp_path: Path) -> None:
    with serving(tmp_path) as service:
        client = service.person_client(["technician"])
        person = client.get("/v1/session").json()["key_id"]
        settings = {"data_dir": tmp_path}
        assert person in specimap(settings, "people").stdout
        assert specimap(settings, "block", person).returncode == 0
        service.app.state.keyring.forget()
        assert client.get("/v1/session").status_code == 401
        assert "blocked" in specimap(settings, "people").stdout
        assert specimap(settings, "unblock", person).returncode == 0
        assert specimap(settings, "block", f"person_{'0' * 26}").returncode == 2
        with service.database.session() as session:
            known_person(session, "https://idp.test", "x")
            actions = session.scalars(sa.select(AuditEntry.action).where(AuditEntry.target == person)).all()
        assert actions == ["person.block", "person.unblock"]

"""People sign in with accounts of a real identity provider, in a real browser, and out again."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from joserfc.jwk import ECKey
from playwright.sync_api import Page, expect

from specimap_infra.tables import AuditEntry, Person
from specimap_service.auth.people import subject_hash
from tests.support.browser_scene import Window
from tests.support.canaille import CLIENT_ID, CLIENT_SECRET, PASSWORD, Canaille, canaille_running
from tests.support.certified_provider import certified_provider
from tests.support.service_scene import Running, serving

pytestmark = pytest.mark.slow
ROLES = {"lab": "technician", "quality": "auditor"}


@dataclass
class Hospital:
    """A service, and the provider of the hospital's accounts."""

    service: Running
    provider: Canaille


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(scope="module")
def hospital(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hospital]:
    folder = tmp_path_factory.mktemp("hospital")
    url = f"http://127.0.0.1:{free_port()}"
    with canaille_running(folder, free_port()) as provider:
        provider.add_user("jane", "lab")
        provider.add_user("john", "quality")
        provider.add_user("guest")
        provider.add_client(url)
        settings: dict[str, Any] = {
            "oidc_issuer": provider.issuer,
            "oidc_client_id": CLIENT_ID,
            "oidc_client_secret": CLIENT_SECRET,
            "oidc_scopes": "openid profile groups",
            "oidc_roles_claim": "groups",
            "oidc_roles": ROLES,
            "oidc_name": "St. Example",
            "public_url": url,
        }
        with serving(folder / "service", bound=int(url.rpartition(":")[2]), **settings) as service:
            yield Hospital(service, provider)


def sign_in(page: Page, name: str) -> None:
    """From the service's page through the provider's, which know the service's own window no longer."""
    page.get_by_test_id("sign-in-account").click()
    page.locator("input[name=login]").fill(name)
    page.keyboard.press("Enter")
    page.locator("input[name=password]").fill(PASSWORD)
    page.keyboard.press("Enter")
    page.wait_for_url(re.compile(r"/#/"))


def own_errors(window: Window, issuer: str) -> None:
    """Leave out what fails in the provider's pages, and what these do against their own policy."""
    window.errors[:] = [error for error in window.errors if "style" not in error and issuer not in error]


def test_a_technician_signs_in_comes_back_and_signs_out(window: Window, hospital: Hospital) -> None:
    page, url = window.page, hospital.service.url
    page.goto(f"{url}/#/jobs")
    expect(page.get_by_test_id("sign-in-account")).to_have_text("Sign in with your account of St. Example")
    assert window.faults() == []
    sign_in(page, "jane")
    expect(page.get_by_role("heading", name="Jobs")).to_be_visible()
    assert page.url == f"{url}/#/jobs"
    expect(page.get_by_test_id("roles")).to_have_text("Technician")
    assert page.get_by_role("link", name="Administration").count() == 0
    assert page.evaluate("document.cookie") == ""
    with hospital.service.database.session() as session:
        own = Person.subject_hash == subject_hash(hospital.provider.issuer, "jane")
        person = session.scalars(sa.select(Person).where(own)).one()
        assert session.scalar(sa.select(AuditEntry.action).where(AuditEntry.target == person.id)) == "session.create"

    page.get_by_role("button", name="Sign out").click()
    # The provider may ask whether to sign out there as well.
    page.wait_for_url(re.compile(rf"{re.escape(hospital.provider.issuer)}|{re.escape(url)}/(#/)?$"))
    page.goto(url)
    expect(page.get_by_test_id("sign-in-account")).to_be_visible()
    assert page.evaluate("fetch('/v1/session').then(answer => answer.status)") == 401
    own_errors(window, hospital.provider.issuer)


def test_an_auditor_sees_the_trail_alone(window: Window, hospital: Hospital) -> None:
    page = window.page
    page.goto(hospital.service.url)
    sign_in(page, "john")
    expect(page.get_by_test_id("roles")).to_have_text("Auditor")
    expect(page.get_by_test_id("audit")).to_contain_text("session.create")
    for name in ("Acquisitions", "Jobs", "Results"):
        assert page.get_by_role("link", name=name).count() == 0
    own_errors(window, hospital.provider.issuer)


def test_an_account_without_a_role_is_told_so(window: Window, hospital: Hospital) -> None:
    page = window.page
    page.goto(hospital.service.url)
    sign_in(page, "guest")
    expect(page.get_by_test_id("sign-in-refused")).to_contain_text("has no role in Specimap")
    page.get_by_label("Language").select_option("it")
    expect(page.get_by_test_id("sign-in-refused")).to_contain_text("non ha alcun ruolo")
    expect(page.get_by_test_id("sign-in-account")).to_have_text("Accedi con il tuo account di St. Example")
    own_errors(window, hospital.provider.issuer)


def test_while_the_provider_is_away_a_key_signs_in(window: Window, tmp_path: Path) -> None:
    port = free_port()
    settings: dict[str, Any] = {
        "oidc_issuer": f"http://127.0.0.1:{free_port()}",
        "oidc_client_id": CLIENT_ID,
        "public_url": f"http://127.0.0.1:{port}",
    }
    with serving(tmp_path, bound=port, **settings) as service:
        page = window.page
        page.goto(service.url)
        expect(page.get_by_test_id("sign-in-account")).to_have_text("Sign in with your hospital account")
        page.get_by_test_id("sign-in-account").click()
        expect(page.get_by_test_id("sign-in-refused")).to_contain_text("does not answer")
        window.sign_in(service.url, service.key())
        expect(page.get_by_role("heading", name="Acquisitions")).to_be_visible()


def test_a_certified_provider_whose_userinfo_has_the_roles(window: Window, tmp_path: Path) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    key = ECKey.generate_key("P-256", {"kid": "first", "use": "sig", "alg": "ES256"})
    with certified_provider(free_port(), url, [key]) as issuer:
        settings: dict[str, Any] = {
            "oidc_issuer": issuer,
            "oidc_client_id": CLIENT_ID,
            "oidc_client_secret": CLIENT_SECRET,
            "oidc_scopes": "openid roles",
            "oidc_roles": {"specimap-admin": "admin"},
            "public_url": url,
        }
        with serving(tmp_path, bound=port, **settings):
            page = window.page
            page.goto(url)
            page.get_by_test_id("sign-in-account").click()
            page.locator("input[name=login]").fill("admin")
            page.locator("input[name=password]").fill("any")
            page.locator("button[type=submit]").click()
            # It asks whether Specimap may know who that is.
            page.locator("button[type=submit]").click()
            page.wait_for_url(re.compile(rf"{re.escape(url)}/#/"))
            expect(page.get_by_test_id("roles")).to_have_text("Administrator")
            page.get_by_role("button", name="Sign out").click()
            page.wait_for_url(re.compile(rf"{re.escape(issuer)}/session/end"))
            page.get_by_role("button", name="Yes").click()
            page.wait_for_url(re.compile(rf"{re.escape(url)}/"))
            expect(page.get_by_test_id("sign-in-account")).to_be_visible()
            own_errors(window, issuer)

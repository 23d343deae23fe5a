"""The identity provider as the service uses it: whose a token is, and the sign-in on the pages."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from authlib.common.urls import add_params_to_uri
from sqlalchemy.orm import Session

from specimap_infra.database import Database
from specimap_infra.settings import ServiceSettings
from specimap_service.auth.credentials import secret_hash
from specimap_service.auth.oidc.claims import found_claim, projects_in, roles_in
from specimap_service.auth.oidc.fetching import provider_client
from specimap_service.auth.oidc.provider import Provider
from specimap_service.auth.oidc.tokens import Rules, access_claims, invalid
from specimap_service.auth.people import Granted, known_person

MOST_KEPT = 10_000


class Identity:
    """The provider that the settings name. Safe to share between threads."""

    def __init__(self, settings: ServiceSettings, database: Database) -> None:
        """Raises SettingsError where the file with certificates does not read. The provider is not asked yet."""
        self.settings = settings
        self.client = provider_client(settings.oidc_ca_file)
        self.provider = Provider(settings.oidc_issuer, self.client)
        self._database = database
        self._granted: OrderedDict[str, Granted] = OrderedDict()
        self._lock = threading.Lock()

    def rules(self, audience: str) -> Rules:
        """Return what a token for this audience must be like."""
        settings = self.settings
        return Rules(tuple(settings.oidc_algorithms), audience, settings.oidc_clock_skew_seconds)

    def of_token(self, token: str) -> Granted:
        """Return whose an access token is, and what its claims give.

        Raises:
            TokenInvalidError, TokenExpiredError: the token does not count.
            IdentityUnavailableError: the provider's keys are not known, and it does not answer.
        """
        audience = self.settings.oidc_audience
        if not audience:
            raise invalid("audience", "access tokens are not taken here")
        claims = access_claims(self.provider, token, self.rules(audience))
        # Checked every time; its person is looked for once, since its claims stay what they are.
        name = secret_hash(token)
        with self._lock:
            found = self._granted.get(name)
        if found is None:
            with self._database.session() as session:
                found = self.granted(session, claims)
            with self._lock:
                self._granted[name] = found
                if len(self._granted) > MOST_KEPT:
                    self._granted.popitem(last=False)
        return found

    def granted(self, session: Session, claims: Mapping[str, Any]) -> Granted:
        """Return the person of checked claims, with the roles and projects that these give."""
        person = known_person(session, self.settings.oidc_issuer, claims["sub"])
        return Granted(person.id, roles_in(claims, self.settings), projects_in(session, claims, self.settings))

    def lacks(self, claims: Mapping[str, Any]) -> bool:
        """Return whether claims lack one that the settings name."""
        names = filter(None, [self.settings.oidc_roles_claim, self.settings.oidc_projects_claim])
        return any(found_claim(claims, name) is None for name in names)

    def end_address(self, id_token: str | None) -> str | None:
        """Return where a browser signs out at the provider too; None where it offers nothing of the kind.

        Raises:
            IdentityUnavailableError: the provider is not known, and does not answer.
        """
        address = self.provider.description().address("end_session_endpoint")
        if address is None:
            return None
        wanted = {
            "client_id": self.settings.oidc_client_id,
            "post_logout_redirect_uri": self.page_address(),
            "id_token_hint": id_token,
        }
        made: str = add_params_to_uri(address, [(name, value) for name, value in wanted.items() if value])
        return made

    def page_address(self, fragment: str = "") -> str:
        """Return the address of the service's pages."""
        return f"{self.settings.public_url.rstrip('/')}/{fragment}"

    def close(self) -> None:
        """Close the connections."""
        self.client.close()

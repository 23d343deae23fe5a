"""The check of the settings against the identity provider: what works, what does not, and what a token means here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from specimap_core.errors import SettingsError, SpecimapError
from specimap_infra.settings import ServiceSettings
from specimap_service.auth.oidc.claims import found_claim, roles_in, words
from specimap_service.auth.oidc.fetching import provider_client
from specimap_service.auth.oidc.provider import KIND_OF, Description, Provider, fetch
from specimap_service.auth.oidc.sign_in import CALLBACK
from specimap_service.auth.oidc.tokens import Rules, checked_claims


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at. ``fine``: None where it is neither good nor bad."""

    what: str
    fine: bool | None
    told: str


def check_identity(settings: ServiceSettings, token: str | None = None) -> Iterator[Finding]:
    """Check the settings against the provider, and what the claims of a token give, an access token or an ID token.

    Claims are named, and of their values only those with an entry in the settings.

    Raises:
        SettingsError: no provider is configured.
    """
    if not settings.oidc_issuer:
        raise SettingsError(
            "No identity provider is configured.",
            advice="Set SPECIMAP_OIDC_ISSUER and what goes with it; docs/identity.md shows how.",
            setting="oidc_issuer",
        )
    with provider_client(settings.oidc_ca_file) as client:
        try:
            described = fetch(client, settings.oidc_issuer)
        except SpecimapError as error:
            yield Finding("provider", False, error.message)
            return
        yield Finding("provider", True, settings.oidc_issuer)
        yield from _of_description(settings, described)
        yield from _of_settings(settings)
        if token:
            yield from _of_token(settings, Provider(settings.oidc_issuer, client), token.strip())


def _of_description(settings: ServiceSettings, described: Description) -> Iterator[Finding]:
    usable = [
        algorithm
        for algorithm in settings.oidc_algorithms
        if any(isinstance(key, KIND_OF[algorithm[:2]]) for key in described.keys)
    ]
    yield Finding("keys", bool(usable), f"{len(described.keys)}, for {', '.join(usable) or 'no allowed signature'}")
    signs = described.says("id_token_signing_alg_values_supported")
    if signs and not set(signs) & set(settings.oidc_algorithms):
        yield Finding("signatures", False, f"it signs with {', '.join(signs)}, none of SPECIMAP_OIDC_ALGORITHMS")
    methods = described.says("code_challenge_methods_supported")
    told = "it takes PKCE with S256" if "S256" in methods else "it does not say that it takes PKCE with S256"
    yield Finding("PKCE", True if "S256" in methods else None, told)
    end = described.address("end_session_endpoint")
    yield Finding("sign-out", True if end else None, end or "it offers no sign-out: its own session goes on")
    lacking = set(settings.oidc_scopes.split()) - set(described.says("scopes_supported"))
    if lacking and described.says("scopes_supported"):
        yield Finding("scopes", None, f"it does not list {', '.join(sorted(lacking))}")


def _of_settings(settings: ServiceSettings) -> Iterator[Finding]:
    yield Finding("redirect", None, f"register {settings.public_url.rstrip('/')}/{CALLBACK} at the provider")
    yield Finding("sign-out redirect", None, f"register {settings.public_url.rstrip('/')}/ at the provider")
    told = f"{len(settings.oidc_roles)} values of {settings.oidc_roles_claim} give a role"
    yield Finding("roles", bool(settings.oidc_roles), told)
    if not settings.oidc_projects_claim:
        yield Finding("projects", None, f"all who sign in work in {settings.oidc_project}")
    else:
        told = f"{len(settings.oidc_projects)} values of {settings.oidc_projects_claim} give a project"
        yield Finding("projects", bool(settings.oidc_projects) or settings.oidc_create_projects, told)
    audience = settings.oidc_audience
    yield Finding("access tokens", None, f"taken for {audience}" if audience else "none are taken")


def _of_token(settings: ServiceSettings, provider: Provider, token: str) -> Iterator[Finding]:
    audiences = filter(None, [settings.oidc_audience, settings.oidc_client_id])
    refusal: SpecimapError | None = None
    for audience in audiences:
        rules = Rules(tuple(settings.oidc_algorithms), audience, settings.oidc_clock_skew_seconds)
        try:
            claims = checked_claims(provider, token, rules)
        except SpecimapError as error:
            refusal = refusal or error
            continue
        yield Finding("token", True, f"it counts, for {audience}")
        for name in filter(None, [settings.oidc_roles_claim, settings.oidc_projects_claim]):
            if found_claim(claims, name) is None:
                there = ", ".join(sorted(claims))
                yield Finding("claim", False, f"there is no {name}; there are {there}")
        roles = roles_in(claims, settings)
        yield Finding("roles", bool(roles), ", ".join(roles) or "the token gives no role")
        if settings.oidc_projects_claim:
            groups = words(found_claim(claims, settings.oidc_projects_claim))
            known = sorted({settings.oidc_projects[group] for group in groups if group in settings.oidc_projects})
            yield Finding("projects", bool(known), ", ".join(known) or "the token gives no project of the settings")
        return
    if refusal is not None:
        yield Finding("token", False, refusal.message)

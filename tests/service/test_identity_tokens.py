"""Access tokens of an identity provider: whose they are, what they permit, and every way in which they are refused."""

from __future__ import annotations

import base64
import hmac
import json
import random
import time
from collections.abc import Callable, Iterator
from typing import Any, get_args

import httpx
import pytest
import sqlalchemy as sa
from joserfc.jwk import ECKey, RSAKey

from specimap_infra.tables import Person
from specimap_service.auth import dependencies
from specimap_service.auth.oidc.identity import Identity
from specimap_service.auth.oidc.provider import AGAIN_SECONDS, FRESH_SECONDS, KEPT_SECONDS
from specimap_service.auth.oidc.tokens import LARGEST_TOKEN, Reason, access_claims
from specimap_service.auth.people import subject_hash
from specimap_service.errors import TokenExpiredError, TokenInvalidError
from tests.support.documented import check_refusal
from tests.support.identity_provider import AUDIENCE, Provider, provider_running, signed
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving

STRANGE = RSAKey.generate_key(2048, {"kid": "strange"})


@pytest.fixture(scope="module")
def provider() -> Iterator[Provider]:
    with provider_running() as running:
        yield running


@pytest.fixture(scope="module")
def service(provider: Provider, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dependencies, "FAILURES_PER_MINUTE", 10**6)
        settings = provider.settings("http://127.0.0.1:1")
        with serving(tmp_path_factory.mktemp("tokens"), **settings) as running:
            yield running


@pytest.fixture(autouse=True)
def _as_before(provider: Provider) -> Iterator[None]:
    account, keys = dict(provider.account), list(provider.keys)
    yield
    provider.account, provider.keys, provider.away = account, keys, False


def asked(service: Running, token: str, path: str = "/v1/jobs") -> httpx.Response:
    answer = httpx.get(
        service.url + path, headers={"Authorization": f"Bearer {token}"}, trust_env=False, verify=NO_TLS, timeout=30
    )
    check_refusal(answer)
    return answer


def identity_of(service: Running) -> Identity:
    found: Identity = service.app.state.identity
    return found


# ---- tokens that count --------------------------------------------------------------------------------


def test_a_program_is_known_by_its_token_and_has_its_roles(service: Running, provider: Provider) -> None:
    answer = asked(service, provider.token(sub="program", roles=["specimap-classifier", "unknown"]), "/v1/session")
    told = answer.json()
    assert answer.status_code == 200
    assert (told["roles"], told["scopes"]) == (["classifier"], ["read", "label"])
    assert told["permissions"] == ["label.write", "result.read"]
    assert [project["name"] for project in told["projects"]] == ["default"]
    assert told["key_id"].startswith("person_")
    assert "program" not in answer.text
    with service.database.session() as session:
        row = session.get_one(Person, told["key_id"])
        assert (row.issuer, row.subject_hash) == (provider.issuer, subject_hash(provider.issuer, "program"))
    again = asked(service, provider.token(sub="program", roles=["specimap-admin"]), "/v1/session").json()
    assert (again["key_id"], again["roles"]) == (told["key_id"], ["admin"])


def test_what_a_token_permits_is_what_its_roles_permit(service: Running, provider: Provider) -> None:
    technician = provider.token(roles=["specimap-technician"])
    assert asked(service, technician).status_code == 200
    refused = asked(service, technician, "/v1/keys")
    assert (refused.status_code, refused.json()["details"]) == (403, {"permission": "key.manage"})
    none = asked(service, provider.token(roles=[]))
    assert (none.status_code, none.json()["code"]) == (403, "forbidden")
    made = httpx.post(
        f"{service.url}/v1/acquisitions",
        json={"specimen_id": "S-1"},
        headers={"Authorization": f"Bearer {technician}"},
        trust_env=False,
        verify=NO_TLS,
    ).json()
    with service.database.session() as session:
        creator = session.execute(
            sa.text("SELECT created_by FROM acquisitions WHERE id = :id"), {"id": made["id"]}
        ).scalar_one()
    assert creator.startswith("person_")


@pytest.mark.parametrize(
    ("header", "claims"),
    [
        ({"typ": "at+jwt"}, {}),
        ({"typ": "application/at+jwt"}, {}),
        ({"alg": "PS256"}, {}),
        ({}, {"aud": ["another", AUDIENCE]}),
        ({}, {"exp": -10}),
        ({}, {"nbf": 10}),
        ({}, {"roles": "specimap-technician"}),
        ({}, {"typ": "Bearer", "nonce": "of the sign-in"}),
        ({}, {"roles": {"specimap-technician": {"org": "x"}}}),
    ],
)
def test_other_tokens_that_count(
    service: Running, provider: Provider, header: dict[str, str], claims: dict[str, Any]
) -> None:
    # Times are seconds from now; the clocks may differ by some.
    claims = {name: int(time.time()) + value if name in ("exp", "nbf") else value for name, value in claims.items()}
    key = provider.keys[0]
    full = {"alg": "RS256", "kid": key.kid, **header}
    token = signed(full, json.dumps(provider.claims(**claims)), key, ("RS256", "PS256"))
    assert asked(service, token).status_code == 200


# ---- tokens that do not -------------------------------------------------------------------------------

Maker = Callable[[Provider], str]


def part(value: Any) -> str:
    text = value if isinstance(value, bytes) else json.dumps(value).encode()
    return base64.urlsafe_b64encode(text).rstrip(b"=").decode()


def unsigned(algorithm: str) -> Maker:
    return lambda p: f"{part({'alg': algorithm, 'kid': 'first'})}.{part(p.claims())}."


def confused(p: Provider) -> str:
    """Signed with the public key, as if it were a secret that both know."""
    # By hand, since libraries refuse to sign with such a secret.
    text = f"{part({'alg': 'HS256', 'kid': 'first'})}.{part(p.claims())}"
    return f"{text}.{part(hmac.digest(p.keys[0].as_pem(private=False), text.encode(), 'sha256'))}"


def with_claims(**claims: Any) -> Maker:
    return lambda p: p.token(**claims)


def with_header(key: RSAKey | None = None, **header: Any) -> Maker:
    return lambda p: p.token(header, key)


def with_payload(text: str | Callable[[Provider], str]) -> Maker:
    return lambda p: signed({"alg": "RS256", "kid": "first"}, text if isinstance(text, str) else text(p), p.keys[0])


def twice(p: Provider) -> str:
    """An audience that is wrong, and one that is right."""
    return json.dumps(p.claims())[:-1] + ', "aud": "https://another.test"}'


def endless(p: Provider) -> str:
    return json.dumps(p.claims(exp=0)).replace('"exp": 0', '"exp": 1e999')


def header_twice(p: Provider) -> str:
    _, payload, signature = p.token().split(".")
    header = part(b'{"alg": "none", "alg": "RS256", "kid": "first"}')
    return f"{header}.{payload}.{signature}"


def changed(p: Provider) -> str:
    header, _, signature = p.token().split(".")
    return f"{header}.{part(p.claims(roles=['specimap-admin']))}.{signature}"


def of_curve(p: Provider) -> str:
    key = ECKey.generate_key("P-256", {"kid": "first"})
    return signed({"alg": "ES256", "kid": "first"}, json.dumps(p.claims()), key, ("ES256",))


def elsewhere(name: str) -> Maker:
    return lambda p: p.token(
        {name: f"{p.issuer}/evil"}, RSAKey.import_key(STRANGE.as_dict(private=True) | {"kid": "first"})
    )


NOW = int(time.time())
INVALID = "token_invalid"
HOSTILE: dict[str, tuple[str, str, Maker]] = {
    "no signature": (INVALID, "algorithm", unsigned("none")),
    "no signature, in other letters": (INVALID, "algorithm", unsigned("nOnE")),
    "no algorithm": (INVALID, "malformed", lambda p: f"{part({'kid': 'first'})}.{part(p.claims())}.AAAA"),
    "shared secret": (INVALID, "algorithm", confused),
    "algorithm not allowed": (
        INVALID,
        "algorithm",
        lambda p: signed({"alg": "RS512", "kid": "first"}, json.dumps(p.claims()), p.keys[0], ("RS512",)),
    ),
    "other kind of key": (INVALID, "unknown_key", of_curve),
    "another's key": (INVALID, "signature", with_header(STRANGE, kid="first")),
    "changed payload": (INVALID, "signature", changed),
    "cut signature": (INVALID, "signature", lambda p: p.token()[:-20]),
    "signature taken off": (INVALID, "signature", lambda p: p.token().rpartition(".")[0] + "."),
    "unknown key": (INVALID, "unknown_key", with_header(STRANGE)),
    "key is a path": (INVALID, "unknown_key", with_header(STRANGE, kid="../../../../dev/null")),
    "key is a query": (INVALID, "unknown_key", with_header(STRANGE, kid="first' UNION SELECT 'x")),
    "key is an address": (INVALID, "unknown_key", with_header(STRANGE, kid="http://127.0.0.1/keys")),
    "key is a long text": (INVALID, "unknown_key", with_header(STRANGE, kid="k" * 1000)),
    "key is no text": (INVALID, "unknown_key", lambda p: f"{part({'alg': 'RS256', 'kid': ['first']})}.{part({})}.AAAA"),
    "key from jku": (INVALID, "signature", elsewhere("jku")),
    "key from x5u": (INVALID, "signature", elsewhere("x5u")),
    "key in the header": (
        INVALID,
        "signature",
        with_header(STRANGE, kid="first", jwk=STRANGE.as_dict(private=False)),
    ),
    "unknown extension": (
        INVALID,
        "malformed",
        lambda p: f"{part({'alg': 'RS256', 'crit': ['x'], 'x': 1})}.{part({})}.AAAA",
    ),
    "unencoded payload": (INVALID, "malformed", lambda p: f"{part({'alg': 'RS256', 'b64': False})}.{part({})}.AAAA"),
    "header twice": (INVALID, "malformed", header_twice),
    "claim twice": (INVALID, "malformed", with_payload(twice)),
    "payload is a list": (INVALID, "malformed", with_payload("[]")),
    "payload is no JSON": (INVALID, "malformed", with_payload("x")),
    "payload is deep": (INVALID, "malformed", with_payload("[" * 6000)),
    "payload has no numbers": (INVALID, "malformed", with_payload('{"exp": NaN}')),
    "payload is no text": (INVALID, "malformed", lambda p: with_payload(chr(0xFF))(p)),
    "bad base64": (INVALID, "malformed", lambda p: "!!!.!!!.!!!"),
    "nothing": (INVALID, "malformed", lambda p: ".."),
    "too large": (INVALID, "too_large", with_claims(more="x" * LARGEST_TOKEN)),
    "other audience": (INVALID, "audience", with_claims(aud="https://another.test")),
    "other audiences": (INVALID, "audience", with_claims(aud=["a", "b"])),
    "no audience": (INVALID, "audience", with_claims(aud=None)),
    "audience is no text": (INVALID, "audience", with_claims(aud={"a": AUDIENCE})),
    "other issuer": (INVALID, "issuer", with_claims(iss="https://another.test")),
    "issuer with a slash": (INVALID, "issuer", lambda p: p.token(iss=f"{p.issuer}/")),
    "no issuer": (INVALID, "issuer", with_claims(iss=None)),
    "issuers": (INVALID, "issuer", lambda p: p.token(iss=[p.issuer])),
    "expired": ("token_expired", "expired", with_claims(exp=NOW - 3600)),
    "no end": (INVALID, "claims", with_claims(exp=None)),
    "end is a text": (INVALID, "claims", with_claims(exp=str(NOW + 300))),
    "end is endless": (INVALID, "claims", with_payload(endless)),
    "end is far": (INVALID, "claims", with_claims(exp=10**12)),
    "not yet": (INVALID, "not_yet_valid", with_claims(nbf=NOW + 3600)),
    "issued later": (INVALID, "not_yet_valid", with_claims(iat=NOW + 3600)),
    "nobody": (INVALID, "claims", with_claims(sub=None)),
    "empty name": (INVALID, "claims", with_claims(sub="")),
    "name is a number": (INVALID, "claims", with_claims(sub=7)),
    "long name": (INVALID, "claims", with_claims(sub="s" * 256)),
    "ID token": (INVALID, "type", with_claims(nonce="n")),
    "ID token by its hash": (INVALID, "type", with_claims(at_hash="h")),
    "ID token by its type": (INVALID, "type", with_claims(typ="ID")),
    "refresh token": (INVALID, "type", with_claims(typ="Refresh")),
    "other type": (INVALID, "type", with_header(typ="secevent+jwt")),
}


def test_every_reason_has_its_hostile_token() -> None:
    assert {reason for _, reason, _ in HOSTILE.values()} == set(get_args(Reason))


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_tokens_are_refused(service: Running, provider: Provider, name: str) -> None:
    code, reason, make = HOSTILE[name]
    answer = asked(service, make(provider))
    assert (answer.status_code, answer.json()["code"]) == (401, code), answer.text
    assert answer.json()["details"] == {"reason": reason}
    assert answer.headers["www-authenticate"] == "Bearer"
    assert answer.json()["advice"]


def test_no_change_to_a_token_counts(service: Running, provider: Provider) -> None:
    rules, known = identity_of(service).rules(AUDIENCE), identity_of(service).provider
    token, chance = provider.token(), random.Random(7)
    assert access_claims(known, token, rules)["sub"] == "alice"
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_.=%\0 "
    for _ in range(1000):
        # The last letter of the signature holds bits that say nothing.
        at, letter = chance.randrange(len(token) - 1), chance.choice(letters)
        changed = chance.choice([token[:at] + letter + token[at + 1 :], token[:at], token[:at] + letter + token[at:]])
        if changed == token:
            continue
        with pytest.raises((TokenInvalidError, TokenExpiredError)):
            access_claims(known, changed, rules)


def test_no_address_in_a_token_is_asked(service: Running, provider: Provider) -> None:
    for name in ("jku", "x5u"):
        assert asked(service, elsewhere(name)(provider)).status_code == 401
    assert "/evil" not in provider.asked


def test_wrong_tokens_are_counted_like_wrong_keys(
    service: Running, provider: Provider, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dependencies, "FAILURES_PER_MINUTE", 3)
    codes = {asked(service, provider.token(aud="x", jti=str(n))).status_code for n in range(6)}
    assert codes == {401, 429}


def test_without_an_audience_no_token_is_taken(provider: Provider, tmp_path: Any) -> None:
    with serving(tmp_path, **provider.settings("http://127.0.0.1:1", oidc_audience="")) as service:
        answer = asked(service, provider.token())
        assert (answer.status_code, answer.json()["details"]) == (401, {"reason": "audience"})


def test_without_a_provider_a_token_is_an_unknown_key(provider: Provider, tmp_path: Any) -> None:
    with serving(tmp_path) as service:
        answer = asked(service, provider.token())
        assert (answer.status_code, answer.json()["code"]) == (401, "unauthorized")


# ---- keys that change, a provider that is away --------------------------------------------------------


class Clock:
    """Time that a test moves."""

    def __init__(self) -> None:
        self.now = time.monotonic()

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(service: Running) -> Iterator[Clock]:
    known, before = identity_of(service).provider, time.monotonic
    clock = Clock()
    known._clock = clock
    clock.now += AGAIN_SECONDS
    yield clock
    known._clock, known._known, known._tried = before, None, None


def test_a_new_key_is_found_and_an_old_one_forgotten(service: Running, provider: Provider, clock: Clock) -> None:
    before = provider.token(jti="before")
    assert asked(service, before).status_code == 200
    provider.keys = [RSAKey.generate_key(2048, {"kid": "second"})]
    clock.now += AGAIN_SECONDS
    assert asked(service, provider.token()).status_code == 200
    dependencies.KEYRING.of(service.app).forget()
    old = asked(service, before)
    assert (old.status_code, old.json()["details"]) == (401, {"reason": "unknown_key"})


def test_a_key_that_was_taken_back_counts_for_minutes_at_most(
    service: Running, provider: Provider, clock: Clock
) -> None:
    token = provider.token(jti="taken back")
    assert asked(service, token).status_code == 200
    provider.keys = [RSAKey.generate_key(2048, {"kid": "third"})]
    clock.now += FRESH_SECONDS
    dependencies.KEYRING.of(service.app).forget()
    assert asked(service, token).json()["details"] == {"reason": "unknown_key"}


def test_unknown_keys_do_not_make_the_service_ask_without_end(
    service: Running, provider: Provider, clock: Clock
) -> None:
    assert asked(service, provider.token(jti="first")).status_code == 200
    before = provider.asked["/keys"]
    for number in range(20):
        assert asked(service, with_header(STRANGE, kid=f"k{number}")(provider)).status_code == 401
    assert provider.asked["/keys"] <= before + 1


def test_tokens_and_keys_count_while_the_provider_is_away(service: Running, provider: Provider, clock: Clock) -> None:
    key = service.client(["read"])
    assert asked(service, provider.token(jti="there")).status_code == 200
    provider.away = True
    clock.now += FRESH_SECONDS
    assert asked(service, provider.token(jti="away")).status_code == 200
    assert key.get("/v1/jobs").status_code == 200
    clock.now += KEPT_SECONDS
    late = asked(service, provider.token(jti="late"))
    assert (late.status_code, late.json()["code"], late.headers["retry-after"]) == (503, "identity_unavailable", "5")
    assert key.get("/v1/jobs").status_code == 200


@pytest.mark.parametrize(
    "metadata",
    [
        {"issuer": "https://another.test"},
        {"jwks_uri": None},
        {"jwks_uri": "http://keys.test/"},
        {"jwks_uri": "file:///etc/passwd"},
        {"token_endpoint": "https://user@idp.test/"},
        {"authorization_endpoint": 7},
    ],
)
def test_a_provider_that_is_not_the_one_meant_does_not_count(
    service: Running, provider: Provider, clock: Clock, metadata: dict[str, Any]
) -> None:
    known = identity_of(service).provider
    known._known = known._tried = None
    provider.metadata = metadata
    try:
        answer = asked(service, provider.token(jti=str(metadata)))
        assert (answer.status_code, answer.json()["code"]) == (503, "identity_unavailable")
    finally:
        provider.metadata = {}

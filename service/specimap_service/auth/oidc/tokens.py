"""JSON Web Tokens of the identity provider, checked before anything in them counts."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any, Literal

from authlib.oidc.core import CodeIDToken
from joserfc import jws
from joserfc.errors import ExpiredTokenError, InvalidClaimError, JoseError, MissingClaimError
from joserfc.jwt import JWTClaimsRegistry

from specimap_service.auth.oidc.provider import Provider
from specimap_service.errors import TokenExpiredError, TokenInvalidError

LARGEST_TOKEN = 16 * 1024
LONGEST_ID = 255
"""Of a key, and of an account: OpenID Connect allows no longer one."""
OF_SIGN_IN = ("nonce", "at_hash", "c_hash", "s_hash")
"""Claims that an ID token has, which says who signed in on a page, and an access token has not."""
Reason = Literal[
    "algorithm",
    "audience",
    "claims",
    "expired",
    "issuer",
    "malformed",
    "not_yet_valid",
    "signature",
    "too_large",
    "type",
    "unknown_key",
]
"""Why a token does not count, in stable words that docs/identity.md explains."""
_OF_CLAIMS: dict[str, Reason] = {"iss": "issuer", "aud": "audience", "nbf": "not_yet_valid", "iat": "not_yet_valid"}
_ADVICE = "Get a new access token from the identity provider, for the audience of this service."


class _Registry(jws.JWSRegistry):
    max_header_length = 8 * 1024


@dataclass(frozen=True)
class Rules:
    """What a token must be like."""

    algorithms: tuple[str, ...]
    audience: str
    skew_seconds: float


def invalid(reason: Reason, told: str) -> TokenInvalidError:
    """Make the error for a token that does not count."""
    return TokenInvalidError(f"The token does not count: {told}.", advice=_ADVICE, reason=reason)


def access_claims(provider: Provider, token: str, rules: Rules) -> dict[str, Any]:
    """Return the claims of an access token that is signed by the provider, for this service, and counts now.

    Raises:
        TokenInvalidError, TokenExpiredError: it does not; ``details['reason']`` says why.
        IdentityUnavailableError: the provider's keys are not known, and it does not answer.
    """
    header, claims = signed(provider, token, rules.algorithms)
    kind = str(header.get("typ", "JWT")).lower().removeprefix("application/")
    # Keycloak's access tokens say what they are, and those of releases before 25 repeat the nonce of the sign-in.
    says = claims.get("typ")
    of_sign_in = says != "Bearer" and any(name in claims for name in OF_SIGN_IN)
    if kind not in ("jwt", "at+jwt") or of_sign_in or says in ("ID", "Refresh"):
        raise invalid("type", "it is an ID token or another, and no access token")
    _check(claims, rules, provider.issuer)
    return claims


def checked_claims(provider: Provider, token: str, rules: Rules) -> dict[str, Any]:
    """Return the claims of a token of either kind, for one who looks at it. Raises as :func:`access_claims`."""
    _, claims = signed(provider, token, rules.algorithms)
    _check(claims, rules, provider.issuer)
    return claims


def id_claims(provider: Provider, token: str, rules: Rules, *, nonce: str, access_token: str | None) -> dict[str, Any]:
    """Return the claims of an ID token that is signed by the provider, for this client and this sign-in.

    Raises: as :func:`access_claims`.
    """
    header, claims = signed(provider, token, rules.algorithms)
    _check(claims, rules, provider.issuer)
    wanted = {"nonce": nonce, "client_id": rules.audience, "access_token": access_token}
    try:
        CodeIDToken(claims, header, {}, wanted).validate(leeway=int(rules.skew_seconds))
    except JoseError as error:
        raise invalid("claims", f"a claim of the ID token is wrong ({error})") from error
    return claims


def signed(provider: Provider, token: str, algorithms: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return header and claims of a token whose signature is the provider's.

    Keys come from the provider's own list alone: what a token says of keys (``jku``, ``x5u``, ``jwk``) is not read.

    Raises: as :func:`access_claims`.
    """
    if len(token) > LARGEST_TOKEN:
        raise invalid("too_large", f"it is longer than {LARGEST_TOKEN} characters")
    registry = _Registry(algorithms=list(algorithms), strict_check_header=False)
    try:
        parsed = jws.extract_compact(token.encode("ascii"), registry=registry)
        header = _strictly(_decoded_header(token))
    except (JoseError, ValueError, TypeError, RecursionError) as error:
        raise invalid("malformed", "it does not read") from error
    algorithm, kid = header.get("alg"), header.get("kid")
    if algorithm not in algorithms:
        raise invalid("algorithm", "its signature is of a kind that does not count here")
    if "crit" in header or "b64" in header:
        raise invalid("malformed", "its header asks for something that is not known here")
    if kid is not None and (not isinstance(kid, str) or len(kid) > LONGEST_ID):
        raise invalid("unknown_key", "its key is not among the provider's")
    key = provider.key(kid, algorithm)
    if key is None:
        raise invalid("unknown_key", "its key is not among the provider's")
    try:
        known = jws.validate_compact(parsed, key, algorithms=list(algorithms), registry=registry)
    except (JoseError, ValueError, TypeError) as error:
        raise invalid("signature", "its signature does not fit") from error
    if not known:
        raise invalid("signature", "its signature does not fit")
    try:
        claims = _strictly(parsed.payload)
    except (ValueError, RecursionError) as error:
        raise invalid("malformed", "it does not read") from error
    return header, claims


def _decoded_header(token: str) -> bytes:
    from joserfc.util import urlsafe_b64decode

    return urlsafe_b64decode(token.partition(".")[0].encode("ascii"))


def _strictly(text: bytes) -> dict[str, Any]:
    """Parse a JSON object. Raises ValueError for another thing, for a name given twice, and for NaN."""

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("a name is given twice")
        return dict(pairs)

    def never(name: str) -> Any:
        raise ValueError(f"{name} is no number")

    found = json.loads(text.decode("utf-8"), object_pairs_hook=once, parse_constant=never)
    if not isinstance(found, dict):
        raise ValueError("no object")
    return found


def _check(claims: dict[str, Any], rules: Rules, issuer: str) -> None:
    registry = JWTClaimsRegistry(
        leeway=int(rules.skew_seconds),
        iss={"essential": True, "value": issuer},
        aud={"essential": True, "value": rules.audience},
        sub={"essential": True},
        exp={"essential": True},
    )
    try:
        registry.validate(claims)
    except ExpiredTokenError as error:
        raise TokenExpiredError("The token has expired.", advice=_ADVICE, reason="expired") from error
    except (InvalidClaimError, MissingClaimError) as error:
        raise invalid(_OF_CLAIMS.get(error.claim, "claims"), f"its claim {error.claim} is missing or wrong") from error
    except (JoseError, TypeError, ValueError, OverflowError) as error:
        raise invalid("claims", "its claims do not read") from error
    subject = claims["sub"]
    if not isinstance(subject, str) or not 1 <= len(subject) <= LONGEST_ID or claims["exp"] > time.time() + 10**9:
        raise invalid("claims", "its claim sub or exp is not plausible")

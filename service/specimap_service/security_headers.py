"""Headers that tell a browser what an answer may do, should anyone open it as a page."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders

POLICY = "content-security-policy"
ANSWERS = "default-src 'none'; frame-ancestors 'none'; sandbox"
"""Of everything but pages, uploaded files too: no script, no part fetched, an origin of its own, in no frame."""
REPORTS = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'; sandbox"
"""Of reports, which hold their styles and pictures."""
DESCRIPTION = (
    "default-src 'none'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self' data:; worker-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Of the pages at ``/docs`` and ``/redoc``, whose texts come from the program itself: a script stands in them."""
DESCRIPTION_PATHS = ("/docs", "/docs/oauth2-redirect", "/redoc")
PAGES = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; worker-src 'self' blob:; manifest-src 'self'; font-src 'self'; media-src 'self' blob:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HSTS_SECONDS = 365 * 24 * 3600


def page_headers() -> dict[str, str]:
    """Return the headers of the service's pages, besides those that every answer carries."""
    return {
        "Content-Security-Policy": PAGES,
        "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
        "X-Frame-Options": "DENY",
        "Cross-Origin-Opener-Policy": "same-origin",
    }


def add_security_headers(headers: MutableHeaders, path: str, public_url: str = "") -> None:
    """Add what every answer carries to one for a request of this path; what the answer has of its own stays."""
    headers["x-content-type-options"] = "nosniff"
    headers.setdefault("referrer-policy", "no-referrer")
    # What may be kept says so itself: neither a browser nor a proxy keeps the rest.
    headers.setdefault("cache-control", "no-store")
    if public_url.lower().startswith("https://"):
        headers["strict-transport-security"] = f"max-age={HSTS_SECONDS}"
    if POLICY in headers:
        return
    if path in DESCRIPTION_PATHS:
        headers[POLICY] = DESCRIPTION
    elif headers.get("content-type", "").startswith("text/html"):
        headers[POLICY] = REPORTS
    else:
        headers[POLICY] = ANSWERS

"""Webhooks: a signed POST when a job has ended, at least once; the delivery's id identifies repetitions."""

from __future__ import annotations

import datetime
import hashlib
import hmac
import ssl
from dataclasses import dataclass
from typing import Any

import httpx
import sqlalchemy as sa

from specimap_core.errors import SettingsError
from specimap_core.json_text import json_text
from specimap_infra.claims import take_due, wait_seconds
from specimap_infra.database import Database, utc_now
from specimap_infra.job_schemas import job_views
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import Delivery, Job

SIGNATURE = "X-Specimap-Signature"
DELIVERY = "X-Specimap-Delivery"
TIMEOUT_SECONDS = 10.0
CLAIM = datetime.timedelta(seconds=90)
"""How long a delivery belongs to the worker that sends it; if that one died, it is due again afterwards."""
FIRST_WAIT_SECONDS = 2.0
LONGEST_WAIT_SECONDS = 900.0
MOST_AT_ONCE = 50
LARGEST_BODY = 256 * 1024


@dataclass(frozen=True)
class _Claimed:
    id: str
    attempt: int
    url: str
    secret: str
    job: dict[str, Any]


def sign(secret: str, body: bytes, at: int) -> str:
    """Make the signature's header: ``t=<unix seconds>,v1=<hex>``, HMAC-SHA256 of ``<t>.<body>``."""
    digest = hmac.new(secret.encode(), f"{at}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={at},v1={digest}"


def check_target(url: str, settings: ServiceSettings) -> None:
    """Refuse an address to which no webhook may be sent.

    Raises:
        SettingsError: it is not a web address, carries a password, or its host is not in ``webhook_hosts``.
    """
    try:
        target = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise _refused("The webhook's url does not read as one.") from error
    if target.scheme not in ("http", "https") or not target.host or target.userinfo:
        raise _refused("The webhook's url is not http(s)://HOST/PATH.")
    allowed = {host.lower() for host in settings.webhook_hosts}
    port = target.port or {"http": 80, "https": 443}[target.scheme]
    if not {target.host.lower(), f"{target.host.lower()}:{port}"} & allowed:
        raise _refused("The webhook's host is not one that this service may send to.")


def _refused(message: str) -> SettingsError:
    return SettingsError(
        message, advice="Ask whoever runs the service to name the host in webhook_hosts.", setting="webhook.url"
    )


def webhook_client() -> httpx.Client:
    """Make a client that connects to the host itself only: no proxy from the environment, no redirect."""
    return httpx.Client(
        trust_env=False,
        follow_redirects=False,
        timeout=TIMEOUT_SECONDS,
        # The system's certificates, which may include a hospital's own authority; httpx brings its own list.
        verify=ssl.create_default_context(),
        headers={"User-Agent": "specimap", "Content-Type": "application/json"},
    )


def deliver_due(database: Database, settings: ServiceSettings, client: httpx.Client) -> int:
    """Send the deliveries that are due, one after the other; workers that do so at once share them.

    Args:
        client: made by :func:`webhook_client`.

    Returns: how many were attempted, at most 50.

    Raises:
        DatabaseUnavailableError: the database failed; the delivery under way is due again after 90 s.
    """
    now = utc_now()
    for done in range(MOST_AT_ONCE):
        claimed = _claim(database, now)
        if claimed is None:
            return done
        status, delivered = _send(claimed, settings, client)
        _record_attempt(database, settings, claimed, status, delivered)
    return MOST_AT_ONCE


def seconds_to_next(database: Database, most: float) -> float:
    """Return how long until a delivery is due, at most ``most``. Raises DatabaseUnavailableError."""
    with database.session() as session:
        next_at = session.scalar(sa.select(sa.func.min(Delivery.next_at)).where(Delivery.state == "pending"))
    return most if next_at is None else min(most, (next_at - utc_now()).total_seconds())


def _claim(database: Database, now: datetime.datetime) -> _Claimed | None:
    due = sa.and_(Delivery.state == "pending", Delivery.next_at <= now)
    while True:
        row = take_due(database, Delivery, due, next_at=utc_now() + CLAIM)
        if row is None:
            return None
        with database.session() as session:
            job = session.get(Job, row.job_id)
            if job is None:
                continue  # deleted meanwhile, and the row with it
            (view,) = job_views(session, [job])
        webhook = job.webhook or {}
        return _Claimed(row.id, row.attempts, webhook["url"], webhook["secret"], view.model_dump(mode="json"))


def _send(claimed: _Claimed, settings: ServiceSettings, client: httpx.Client) -> tuple[str, bool]:
    """Attempt a delivery; return its status in a word, and whether the host accepted it."""
    try:
        check_target(claimed.url, settings)
    except SettingsError:
        return "host not allowed", False
    sent = utc_now()
    content = {"event": f"job.{claimed.job['state']}", "job": claimed.job, "delivered_at": sent.isoformat()}
    body = json_text(content).encode()
    if len(body) > LARGEST_BODY and claimed.job["error"]:
        content["job"] = {**claimed.job, "error": {**claimed.job["error"], "details": {}}}
        body = json_text(content).encode()
    headers = {SIGNATURE: sign(claimed.secret, body, int(sent.timestamp())), DELIVERY: claimed.id}
    try:
        # Streamed, so that an endless answer is not read.
        with client.stream("POST", claimed.url, content=body, headers=headers) as answer:
            return str(answer.status_code), answer.is_success
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
        return type(error).__name__, False


def _record_attempt(
    database: Database, settings: ServiceSettings, claimed: _Claimed, status: str, delivered: bool
) -> None:
    last = claimed.attempt >= settings.webhook_attempts
    state = "delivered" if delivered else "given_up" if last else "pending"
    wait = datetime.timedelta(seconds=wait_seconds(claimed.attempt, FIRST_WAIT_SECONDS, LONGEST_WAIT_SECONDS))
    with database.session() as session:
        session.execute(
            # If another worker has sent it meanwhile, its result counts.
            sa.update(Delivery)
            .where(Delivery.id == claimed.id, Delivery.attempts == claimed.attempt, Delivery.state == "pending")
            .values(state=state, last_status=status, next_at=utc_now() + wait)
        )
    log = logger().info if delivered else logger().warning
    log("webhook", delivery=claimed.id, job=claimed.job["id"], attempt=claimed.attempt, status=status, state=state)

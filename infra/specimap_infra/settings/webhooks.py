"""Webhooks."""

from __future__ import annotations

from pydantic import BaseModel, Field


class WebhookSettings(BaseModel):
    """Webhooks."""

    webhook_hosts: list[str] = Field(
        default_factory=list,
        description="Hosts that webhooks may be sent to, as a JSON list; none by default, so nothing leaves the machine.",
    )
    webhook_attempts: int = Field(default=8, ge=1, description="Attempts to deliver a webhook, at growing intervals.")

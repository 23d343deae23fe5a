"""Pseudonyms of de-identified exports: keyed, so that nobody without the key finds what they stand for.

The same input has the same pseudonym as long as the key stays; with another key all are new.
"""

from __future__ import annotations

import base64
import datetime
import hashlib
import hmac
from dataclasses import dataclass, field

from specimap_core.errors import SettingsError
from specimap_infra.settings import ServiceSettings

MOST_DAYS = 3652
"""Dates are moved back by a day to ten years."""


@dataclass(frozen=True)
class Pseudonyms:
    """Derives pseudonyms and shifts of dates from a key."""

    key: bytes = field(repr=False)

    @classmethod
    def of(cls, settings: ServiceSettings) -> Pseudonyms:
        """Take the key from the settings.

        Raises:
            SettingsError: there is none.
        """
        key = settings.pseudonym_secret.get_secret_value().encode()
        if not key:
            raise SettingsError(
                "De-identified exports need a key, and none is set.",
                advice="Set SPECIMAP_PSEUDONYM_SECRET for the API and the workers.",
                setting="pseudonym_secret",
            )
        return cls(key)

    @property
    def key_id(self) -> str:
        """A name for the key that gives nothing away."""
        return self._digest("key", "")[:6].hex()

    def of_text(self, kind: str, value: str) -> str:
        """Return the pseudonym of a value, 16 letters and digits; kinds never share pseudonyms."""
        return base64.b32encode(self._digest(kind, value)[:10]).decode().lower()

    def shifted(self, specimen_id: str, moment: datetime.datetime) -> datetime.date:
        """Return the day of a moment, moved back by as many days as all dates of the specimen are."""
        days = int.from_bytes(self._digest("shift", specimen_id)[:8]) % MOST_DAYS + 1
        return moment.astimezone(datetime.UTC).date() - datetime.timedelta(days=days)

    def _digest(self, kind: str, value: str) -> bytes:
        return hmac.new(self.key, f"{kind}\0{value}".encode(), hashlib.sha256).digest()

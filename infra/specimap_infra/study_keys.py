"""Encryption of study contexts: AES-256-GCM, with keys from the settings.

Each row names the key that opens it, and is bound to its acquisition: put in another one's place, it does not open.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    from specimap_infra.settings import ServiceSettings

KEY_BYTES = 32
NONCE_BYTES = 12


class KeyTextError(ValueError):
    """A text is no key."""


class SealError(Exception):
    """What was sealed does not open: it was changed, or belongs elsewhere."""


class KeyMissingError(Exception):
    """The key that a text was sealed with is not among those given."""


@dataclass(frozen=True)
class StudyKey:
    """A key, and its id, which tells nothing of it."""

    secret: bytes = field(repr=False)

    @classmethod
    def of(cls, text: str) -> StudyKey:
        """Read a key: 32 bytes in base64, of either alphabet. Raises KeyTextError, which does not repeat it."""
        try:
            secret = base64.b64decode(text.strip().replace("-", "+").replace("_", "/"), validate=True)
        except (binascii.Error, ValueError):
            raise KeyTextError("no base64") from None
        if len(secret) != KEY_BYTES:
            raise KeyTextError("not 32 bytes")
        return cls(secret)

    @property
    def id(self) -> str:
        """Sixteen hexadecimal digits."""
        return hashlib.sha256(b"specimap study key\0" + self.secret).hexdigest()[:16]


def new_key() -> str:
    """Make a key's text."""
    return base64.urlsafe_b64encode(secrets.token_bytes(KEY_BYTES)).decode()


@dataclass(frozen=True)
class StudyKeys:
    """The keys of the settings. The first one seals; all open."""

    keys: tuple[StudyKey, ...]

    @classmethod
    def of(cls, texts: Sequence[str]) -> StudyKeys:
        """Read the keys. Raises KeyTextError."""
        return cls(tuple(StudyKey.of(text) for text in texts))

    @classmethod
    def of_settings(cls, settings: ServiceSettings) -> StudyKeys:
        """The keys that the settings name, which have been read once before."""
        return cls.of([key.get_secret_value() for key in settings.study_keys])

    def __bool__(self) -> bool:
        return bool(self.keys)

    @property
    def newest(self) -> str:
        """Id of the key that seals."""
        return self.keys[0].id

    def seal(self, text: bytes, owner: str) -> tuple[str, str]:
        """Encrypt for an owner. Returns the id of the key, and what is to be kept."""
        nonce = secrets.token_bytes(NONCE_BYTES)
        sealed = _cipher(self.keys[0]).encrypt(nonce, text, _bound_to(owner))
        return self.newest, base64.b64encode(nonce + sealed).decode()

    def open(self, key_id: str, kept: str, owner: str) -> bytes:
        """Decrypt what :meth:`seal` gave for the same owner.

        Raises:
            KeyMissingError: its key is not among these. SealError: it does not open.
        """
        from cryptography.exceptions import InvalidTag

        found = next((key for key in self.keys if key.id == key_id), None)
        if found is None:
            raise KeyMissingError
        try:
            whole = base64.b64decode(kept, validate=True)
            return _cipher(found).decrypt(whole[:NONCE_BYTES], whole[NONCE_BYTES:], _bound_to(owner))
        except (InvalidTag, ValueError):
            raise SealError from None


def _bound_to(owner: str) -> bytes:
    return b"specimap study\0" + owner.encode()


def _cipher(key: StudyKey) -> AESGCM:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    return AESGCM(key.secret)

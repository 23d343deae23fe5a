"""Text out of a file made fit for a message: anybody may have written it."""

from __future__ import annotations

_MOST = 80


def printable(text: str, most: int = _MOST) -> str:
    """At most ``most`` characters of a text, none of which moves a terminal's cursor or is half a character."""
    plain = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return plain if len(plain) <= most else plain[: most - 3] + "..."

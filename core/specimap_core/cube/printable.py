"""Words out of a file, fit for a message: a stranger may have written them."""

from __future__ import annotations

_MOST = 80


def shown(text: str, most: int = _MOST) -> str:
    """At most ``most`` characters of a text, none of which moves a terminal's cursor or is half a character."""
    plain = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return plain if len(plain) <= most else plain[: most - 3] + "..."

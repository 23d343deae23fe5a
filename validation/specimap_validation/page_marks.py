"""Text between marks of a page, kept up to date by programs."""

from __future__ import annotations

import re
from pathlib import Path

from specimap_core.atomic import write_text
from specimap_core.errors import SettingsError


def put(page: Path, mark: str, text: str) -> None:
    """Replace the text between ``<!-- mark -->`` and ``<!-- /mark -->`` of a page.

    Raises:
        SettingsError: see :func:`check_marks`.
    """
    old = check_marks(page, mark)
    write_text(page, _place(mark).sub(lambda m: f"{m[1]}{text}\n{m[2]}", old))


def check_marks(page: Path, mark: str) -> str:
    """Return the text of a page that has exactly one such place.

    Raises:
        SettingsError: the page does not exist, or has no such place, or several.
    """
    if not page.is_file():
        raise SettingsError(f"There is no page {page}.", advice="Name a page of markdown.", setting="page")
    text = page.read_text(encoding="utf-8")
    count = len(_place(mark).findall(text))
    if count != 1:
        raise SettingsError(
            f"{page.name} has {count} places marked {mark}.",
            advice=f"Put <!-- {mark} --> and <!-- /{mark} --> around the place, once.",
            setting="page",
        )
    return text


def _place(mark: str) -> re.Pattern[str]:
    return re.compile(rf"(<!-- {mark} -->\n).*?(<!-- /{mark} -->)", re.DOTALL)

"""The codes that docs/errors.md lists."""

from __future__ import annotations

import re

from tests.support.places import DOCS


def table_of(heading: str) -> set[str]:
    """Codes in the first column of the table under ``heading``."""
    text = (DOCS / "errors.md").read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return {code for cell in cells for code in re.findall(r"`([a-z0-9_]+)`", cell)}

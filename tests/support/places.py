"""Where the project's folders are."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "samples"
DOCS = ROOT / "docs"
SUPPORT = Path(__file__).parent

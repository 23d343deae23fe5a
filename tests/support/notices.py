"""Warnings of a cube, a reconstruction or a report, by code."""

from __future__ import annotations

from collections.abc import Iterable

from specimap_core.notices import Notice


def messages(warnings: Iterable[Notice]) -> dict[str, str]:
    """The message of each code."""
    return {warning.code: warning.message for warning in warnings}

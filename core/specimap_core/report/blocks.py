"""Building blocks of a document, for HTML and PDF alike. All text is plain: no markup, nothing escaped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Level = Literal["good", "attention", "note"]


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list; an item is a term, which may be empty, and its description."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Callout:
    """Something to see at once: what is the case, and what to do, which may be empty."""

    level: Level
    title: str
    text: str
    action: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of texts under a head. ``numeric``: columns set to the right; ``widths``: shares of the page, for PDF.

    ``marks``: a level for each row, or none.
    """

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    widths: tuple[float, ...]
    numeric: tuple[int, ...] = ()
    marks: tuple[Level, ...] = ()


@dataclass(frozen=True)
class Picture:
    """A figure, drawn when it is its turn, so that one is in memory at a time.

    ``kind``: a ``chart`` is kept as lines where the format can, a ``map`` as pixels, a ``photo`` with losses. ``alt``
    describes it to readers who cannot see it; ``caption`` tells everyone how to read it.
    """

    draw: Callable[[], Figure]
    kind: Literal["chart", "map", "photo"]
    alt: str
    caption: str


Block = Paragraph | Bullets | Callout | Table | Picture


@dataclass(frozen=True)
class Section:
    """A heading with its blocks; ``anchor`` names it within the document."""

    anchor: str
    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """A whole document. ``created``: when the run ended, so that drawing it twice gives the same bytes."""

    title: str
    subtitle: str
    created: str
    footer: str
    sections: tuple[Section, ...]

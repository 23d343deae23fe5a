"""A table of figures, once for the terminal and once for the documents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.console import Console
from rich.table import Table

NONE = "-"


@dataclass
class Sheet:
    """``rows`` under ``headings``; the first column is text, the others are numbers. ``notes`` stand below."""

    title: str
    headings: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def show(self, console: Console) -> None:
        """Print it."""
        table = Table(title=self.title, title_justify="left")
        for number, heading in enumerate(self.headings):
            table.add_column(heading, justify="right" if number else "left", no_wrap=number > 0)
        for row in self.rows:
            table.add_row(*row)
        console.print(table)
        for note in self.notes:
            console.print(note, highlight=False)

    def markdown(self) -> str:
        """The same for a document."""
        lines = [f"{self.title}:", ""] if self.title else []
        lines += [_line(self.headings), _line(["---", *["---:"] * (len(self.headings) - 1)])]
        lines += [_line(row) for row in self.rows]
        if self.notes:
            lines += ["", " ".join(self.notes)]
        return "\n".join(lines)


def reached(value: float, target: float, *, least: bool) -> str:
    """Whether a figure reaches its target: ``least`` says that it is to be at least that."""
    return "yes" if (value >= target if least else value <= target) else "NO"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"

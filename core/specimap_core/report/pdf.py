"""A document as PDF, A4, with its outline as bookmarks; the same document gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from specimap_core.atomic import atomic_path
from specimap_core.errors import BackendUnavailableError
from specimap_core.report import plotting
from specimap_core.report.blocks import Bullets, Callout, Document, Paragraph, Picture, Table

MARGIN_MM = 16.0
SANS, BOLD = "SpecimapSans", "SpecimapSans-Bold"
LEAST_LEFT_PT = 140.0
"""A heading or table that would begin lower than this over the page's end begins on the next."""
HALF_PAGE_PT = 310.0
"""Two figures of this height, with their captions and a heading, share a page."""
COLOURS = {"good": ("#00734f", "#eaf5f0"), "attention": ("#b34700", "#fdf0e6"), "note": ("#5a5a5a", "#f4f4f4")}
"""Bar and ground of a callout, by its level."""


def write_pdf(document: Document, target: Path, progress: Callable[[float], None]) -> Path:
    """Write ``target`` whole or not at all.

    Raises:
        BackendUnavailableError: ReportLab or matplotlib is not installed.
        StorageFullError, OutputNotWritableError: as of any file.
    """
    try:
        from reportlab import rl_config
        from reportlab.lib.pagesizes import A4
        from reportlab.lib.units import mm
        from reportlab.platypus import BaseDocTemplate, Frame, PageTemplate
    except ImportError as error:
        raise BackendUnavailableError(
            "The report as PDF needs ReportLab, which is not installed.", advice="Install specimap[pipeline]."
        ) from error
    # Streams as text would be a quarter larger and, written in Python, take longer than all the rest.
    rl_config.useA85 = 0
    _register_fonts()
    margin = MARGIN_MM * mm
    frame = Frame(margin, margin, A4[0] - 2 * margin, A4[1] - 2 * margin, 0, 0, 0, 0)
    out = io.BytesIO()
    made = BaseDocTemplate(
        out,
        pagesize=A4,
        title=f"{document.title}: {document.subtitle}",
        author="Specimap",
        invariant=1,
        lang="en",
        pageTemplates=[PageTemplate(frames=[frame], onPage=lambda canvas, _: _foot(canvas, document, margin, A4))],
    )
    made.build(list(_story(document, frame._width, progress)))
    with atomic_path(target) as aside:
        aside.write_bytes(out.getvalue())
    progress(1.0)
    return target


def _register_fonts() -> None:
    """DejaVu, which comes with matplotlib, has the signs and the letters that PDF's own fonts lack."""
    plotting.quiet_matplotlib()
    import matplotlib
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont

    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    for name, file in ((SANS, "DejaVuSans.ttf"), (BOLD, "DejaVuSans-Bold.ttf")):
        if name not in pdfmetrics.getRegisteredFontNames():
            pdfmetrics.registerFont(TTFont(name, str(folder / file)))
    pdfmetrics.registerFontFamily(SANS, normal=SANS, bold=BOLD, italic=SANS, boldItalic=BOLD)


def _style(size: float, *, bold: bool = False, colour: str = "#1b1b1b", before: float = 0, after: float = 4) -> Any:
    from reportlab.lib.colors import HexColor
    from reportlab.lib.styles import ParagraphStyle

    return ParagraphStyle(
        f"{size}{bold}{colour}{before}{after}",
        fontName=BOLD if bold else SANS,
        fontSize=size,
        leading=size * 1.38,
        textColor=HexColor(colour),
        spaceBefore=before,
        spaceAfter=after,
        splitLongWords=1,
    )


def _text(text: str, style: Any, label: str = "") -> Any:
    """A paragraph of plain text after a bold label; signs that cannot be printed are left out."""
    from reportlab.platypus import Paragraph as Flowable

    plain = escape("".join(c if c.isprintable() else " " for c in text))
    return Flowable(f"<b>{label}</b> {plain}" if label else plain, style)


def _story(document: Document, width: float, progress: Callable[[float], None]) -> Iterator[Any]:
    from reportlab.platypus import CondPageBreak, KeepTogether, Spacer

    pictures = sum(isinstance(b, Picture) for section in document.sections for b in section.blocks)
    done = 0
    yield _text(document.title, _style(20, bold=True, after=2))
    yield _text(document.subtitle, _style(9, colour="#5a5a5a", after=10))
    for section in document.sections:
        # A heading and what introduces a block wait for it, so that no page break parts them.
        waiting = _heading(section.title)
        for block in section.blocks:
            if isinstance(block, Paragraph):
                waiting.append(_text(block.text, _style(9)))
                continue
            if isinstance(block, Picture):
                progress(done / max(pictures, 1))
                done += 1
                yield KeepTogether([*waiting, *_picture(block, width)])
            else:
                yield CondPageBreak(LEAST_LEFT_PT)
                yield from waiting
                yield from _flowables(block, width)
            waiting = []
        yield from waiting
        yield Spacer(1, 6)


def _heading(title: str) -> list[Any]:
    from reportlab.platypus import Flowable

    class Bookmark(Flowable):  # type: ignore[misc]
        width = height = 0

        def draw(self) -> None:
            self.canv.bookmarkHorizontal(title, 0, 24)
            self.canv.addOutlineEntry(title, title, 0, False)

    return [Bookmark(), _text(title, _style(13.5, bold=True, before=10, after=6))]


def _flowables(block: Bullets | Callout | Table, width: float) -> Iterator[Any]:
    from reportlab.platypus import Spacer

    if isinstance(block, Callout):
        yield _callout(block, width)
        yield Spacer(1, 7)
    elif isinstance(block, Bullets):
        rows = [
            [_text(term, _style(8.5, colour="#5a5a5a", after=0)), _text(text, _style(8.5, after=0))]
            for term, text in block.items
        ]
        yield _grid(rows, [0.3 * width, 0.7 * width], [])
        yield Spacer(1, 6)
    else:
        yield from _table(block, width)


def _callout(block: Callout, width: float) -> Any:
    from reportlab.lib.colors import HexColor

    bar, ground = COLOURS[block.level]
    parts = [_text(block.title, _style(10, bold=True, after=2))]
    if block.text:
        parts.append(_text(block.text, _style(9, after=2)))
    if block.action:
        parts.append(_text(block.action, _style(9, after=0), label="What to do:"))
    commands = [
        ("BACKGROUND", (0, 0), (-1, -1), HexColor(ground)),
        ("LINEBEFORE", (0, 0), (0, -1), 4, HexColor(bar)),
        ("LEFTPADDING", (0, 0), (-1, -1), 10),
        ("TOPPADDING", (0, 0), (-1, -1), 6),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 7),
    ]
    return _grid([[parts]], [width], commands)


def _table(block: Table, width: float) -> Iterator[Any]:
    from reportlab.lib.colors import HexColor
    from reportlab.platypus import Spacer

    yield _text(block.caption, _style(9, bold=True, before=5, after=3))
    right = {c: _style(8, after=0).clone("right", alignment=2) for c in block.numeric}
    plain = _style(8, after=0)

    def cell(text: str, column: int, mark: str) -> Any:
        if mark == "attention" and column in (0, len(block.head) - 1):
            return _text(text, _style(8, bold=True, colour="#8f3900", after=0))
        return _text(text, right.get(column, plain))

    head = [
        _text(text, (_style(8, bold=True, after=0)).clone("head", alignment=2 if c in block.numeric else 0))
        for c, text in enumerate(block.head)
    ]
    marks = block.marks or ("",) * len(block.rows)
    rows = [[cell(text, c, mark) for c, text in enumerate(row)] for row, mark in zip(block.rows, marks, strict=True)]
    total = sum(block.widths)
    commands = [
        ("LINEBELOW", (0, 0), (-1, 0), 1, HexColor("#8a8a8a")),
        ("LINEBELOW", (0, 1), (-1, -1), 0.4, HexColor("#d8d8d8")),
    ]
    yield _grid([head, *rows], [width * share / total for share in block.widths], commands, repeat=1)
    yield Spacer(1, 9)


def _grid(rows: list[list[Any]], widths: list[float], commands: list[Any], repeat: int = 0) -> Any:
    from reportlab.platypus import Table as Flowable

    base = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("LEFTPADDING", (0, 0), (-1, -1), 0),
        ("RIGHTPADDING", (0, 0), (-1, -1), 6),
        ("TOPPADDING", (0, 0), (-1, -1), 2.5),
        ("BOTTOMPADDING", (0, 0), (-1, -1), 3.5),
    ]
    return Flowable(rows, colWidths=widths, style=[*base, *commands], repeatRows=repeat, hAlign="LEFT")


def _picture(block: Picture, width: float) -> list[Any]:
    from reportlab.platypus import Image

    figure = block.draw()
    wide, high = (72 * float(side) for side in figure.get_size_inches())
    share = min(1.0, width / wide) if block.kind == "photo" else min(1.0, width / wide, HALF_PAGE_PT / high)
    drawn = plotting.jpeg if block.kind == "photo" else plotting.png
    image = Image(io.BytesIO(drawn(figure, plotting.PRINT_DPI)), share * wide, share * high, hAlign="LEFT")
    return [image, _text(block.caption, _style(8.5, colour="#3c3c3c", before=3, after=12))]


def _foot(canvas: Any, document: Document, margin: float, size: tuple[float, float]) -> None:
    from reportlab.lib.colors import HexColor

    canvas.saveState()
    canvas.setFont(SANS, 7.5)
    canvas.setFillColor(HexColor("#5a5a5a"))
    canvas.drawString(margin, margin * 0.55, document.footer)
    canvas.drawRightString(size[0] - margin, margin * 0.55, f"{canvas.getPageNumber()}")
    canvas.restoreState()

"""A document as one HTML file: nothing is fetched, no script runs, and it prints."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from pathlib import Path

from specimap_core.atomic import write_text
from specimap_core.errors import BackendUnavailableError
from specimap_core.report import plotting
from specimap_core.report.blocks import Block, Document, Picture

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: #1b1b1b; line-height: 1.5;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main, header, footer, nav { max-width: 62rem; margin: 0 auto; padding: 0 1.5rem; }
header { padding-top: 2.5rem; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0; }
.subtitle { color: #5a5a5a; margin: .3rem 0 1.2rem; }
nav ul { list-style: none; display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; margin: 0; padding: .6rem 0;
  border-top: 1px solid #d0d0d0; border-bottom: 1px solid #d0d0d0; }
a { color: #00558a; }
h2 { font-size: 1.4rem; line-height: 1.25; margin: 2.6rem 0 .8rem; }
p { max-width: 46rem; margin: .7rem 0; }
.callout { border-left: .4rem solid #5a5a5a; background: #f4f4f4; padding: .8rem 1.1rem; margin: 1rem 0; }
.callout.good { border-color: #00734f; background: #eaf5f0; }
.callout.attention { border-color: #b34700; background: #fdf0e6; }
.callout h3 { margin: 0; font-size: 1.05rem; overflow-wrap: anywhere; }
.callout p { margin: .35rem 0 0; max-width: none; overflow-wrap: anywhere; }
#verdict .callout:first-of-type h3 { font-size: 1.3rem; }
.scroll { overflow-x: auto; margin: 1.2rem 0; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
caption { text-align: left; font-weight: 600; padding-bottom: .4rem; }
th, td { text-align: left; vertical-align: top; padding: .38rem .8rem .38rem 0; border-bottom: 1px solid #e0e0e0;
  overflow-wrap: break-word; }
thead th { border-bottom: 2px solid #8a8a8a; font-weight: 600; }
tbody th { font-weight: 400; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.good td:last-child { color: #00634a; }
tr.attention td:last-child, tr.attention th { color: #8f3900; font-weight: 600; }
dl { display: grid; grid-template-columns: minmax(10rem, 16rem) 1fr; gap: .3rem 1.2rem; font-size: .92rem; }
dt { color: #5a5a5a; }
dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 1.6rem 0; }
figure img { display: block; max-width: 100%; height: auto; }
figcaption { color: #3c3c3c; font-size: .92rem; margin-top: .5rem; max-width: 46rem; }
footer { color: #5a5a5a; font-size: .88rem; padding-top: 2.5rem; padding-bottom: 2.5rem; }
@media (max-width: 40rem) { dl { grid-template-columns: 1fr; } dd { margin-bottom: .4rem; } }
@media print {
  body { font-size: 10pt; } nav { display: none; } main, header, footer { max-width: none; padding: 0; }
  figure, .callout, tr { break-inside: avoid; } h2 { break-after: avoid; } .scroll { overflow: visible; }
  thead { display: table-header-group; } .callout { border: 1px solid #8a8a8a; border-left-width: .4rem; }
}
@page { size: A4; margin: 16mm; }
"""

TEMPLATE = """
{%- macro block(b) -%}
{%- set kind = b.__class__.__name__ -%}
{%- if kind == "Paragraph" %}
<p>{{ b.text }}</p>
{%- elif kind == "Callout" %}
<div class="callout {{ b.level }}"><h3>{{ b.title }}</h3>
{%- if b.text %}<p>{{ b.text }}</p>{% endif %}
{%- if b.action %}<p><strong>What to do:</strong> {{ b.action }}</p>{% endif %}</div>
{%- elif kind == "Bullets" %}
<dl>{% for term, text in b.items %}<dt>{{ term }}</dt><dd>{{ text }}</dd>{% endfor %}</dl>
{%- elif kind == "Table" %}
<div class="scroll"><table><caption>{{ b.caption }}</caption>
<thead><tr>{% for cell in b.head %}<th scope="col"{{ numeric(b, loop.index0) }}>{{ cell }}</th>{% endfor %}</tr></thead>
<tbody>
{%- for row in b.rows %}{% set mark = b.marks[loop.index0] if b.marks else "" %}
<tr{% if mark %} class="{{ mark }}"{% endif %}>
{%- for cell in row %}
{%- if loop.first %}<th scope="row"{{ numeric(b, 0) }}>{{ cell }}</th>
{%- else %}<td{{ numeric(b, loop.index0) }}>{{ cell }}</td>{% endif %}{% endfor %}</tr>
{%- endfor %}
</tbody></table></div>
{%- elif kind == "Picture" %}{% set shown = drawn(b) %}
<figure><img src="{{ shown.source }}" width="{{ shown.width }}" height="{{ shown.height }}" alt="{{ b.alt }}">
<figcaption>{{ b.caption }}</figcaption></figure>
{%- endif -%}
{%- endmacro -%}
{%- macro numeric(table, column) %}{% if column in table.numeric %} class="number"{% endif %}{% endmacro -%}
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{{ document.title }}: {{ document.subtitle }}</title>
<style>{{ style }}</style>
</head>
<body>
<header><h1>{{ document.title }}</h1><p class="subtitle">{{ document.subtitle }}</p></header>
<nav aria-label="Sections"><ul>
{%- for section in document.sections %}<li><a href="#{{ section.anchor }}">{{ section.title }}</a></li>{% endfor -%}
</ul></nav>
<main>
{%- for section in document.sections %}
<section id="{{ section.anchor }}"><h2>{{ section.title }}</h2>
{%- for b in section.blocks %}{{ block(b) }}{% endfor %}
</section>
{%- endfor %}
</main>
<footer><p>{{ document.footer }}</p></footer>
</body>
</html>
"""


class Shown:
    """A drawn picture: its data URI, and its size in CSS pixels."""

    def __init__(self, picture: Picture) -> None:
        figure = picture.draw()
        wide, high = figure.get_size_inches()
        self.width, self.height = round(96 * wide), round(96 * high)
        if picture.kind == "chart":
            data, media = plotting.svg(figure).encode(), "image/svg+xml"
        elif picture.kind == "photo":
            data, media = plotting.jpeg(figure), "image/jpeg"
        else:
            data, media = plotting.png(figure), "image/png"
        self.source = f"data:{media};base64,{base64.b64encode(data).decode('ascii')}"


def write_page(document: Document, target: Path, progress: Callable[[float], None]) -> Path:
    """Write ``target`` whole or not at all.

    Raises:
        BackendUnavailableError: Jinja or matplotlib is not installed.
        StorageFullError, OutputNotWritableError: as of any file.
    """
    try:
        from jinja2 import Environment, StrictUndefined
        from markupsafe import Markup
    except ImportError as error:
        raise BackendUnavailableError(
            "The report as HTML needs Jinja2, which is not installed.", advice="Install specimap[pipeline]."
        ) from error
    pictures = sum(isinstance(b, Picture) for section in document.sections for b in section.blocks)
    done = 0

    def drawn(block: Block) -> Shown:
        nonlocal done
        assert isinstance(block, Picture)
        progress(done / max(pictures, 1))
        done += 1
        return Shown(block)

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    template = environment.from_string(TEMPLATE.lstrip())
    out = io.StringIO()
    style = Markup(STYLE)  # noqa: S704 - a constant of this module
    for piece in template.generate(document=document, style=style, drawn=drawn):
        out.write(piece)
    write_text(target, out.getvalue())
    progress(1.0)
    return target

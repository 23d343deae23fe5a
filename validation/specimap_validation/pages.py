"""A study or a validation as files for people: one self-contained page of HTML, and its figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from specimap_core.atomic import atomic_path, write_text
from specimap_core.errors import BackendUnavailableError
from specimap_core.report import published
from specimap_core.report.plotting import PRINT_DPI, figure, png, svg
from specimap_validation.subsampling import Study
from specimap_validation.tables import Table, in_words, study_table, validation_tables
from specimap_validation.validation import Validation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TEMPLATE = Path(__file__).parent / "templates" / "page.html"


@dataclass(frozen=True)
class Drawn:
    """A figure on the page."""

    caption: str
    svg: str


def check_drawing() -> None:
    """Refuse a missing package before hours of work rather than after.

    Raises:
        BackendUnavailableError: a package that draws figures or pages is missing.
    """
    figure()
    _page("", [], [], [])


def publish_study(study: Study, out: Path) -> list[Path]:
    """Write ``subsampling.html`` and the two figures as PNG and SVG; the paths written."""
    from specimap_validation.figures import study_2d, study_3d

    lines = [
        f"{study.acquisition}: {study.photos} photos, {study.method} registration, {study.adjustment} adjustment, "
        f"Specimap {study.specimap_version}. Each run reconstructs from a random share of the photos; all photos are "
        "used once.",
        "A run can state its corner errors itself. The true error needs an acquisition of known geometry: it is the "
        "distance between the place where a spectrum of the specimen was put and the place where it was measured.",
        f"{published.REFERENCE} state a 2D corner error of {published.CORNER_2D_WORDS} mm and a 3D corner error of "
        f"{published.CORNER_3D_WORDS} mm with all views, and more than {published.DROPPED_3D_MM:g} mm as soon as a "
        "tenth of the views is missing; their specimens are different ones.",
    ]
    figures = {
        "subsampling_2d": ("2D corner error of every run; the line joins the medians.", lambda: study_2d(study)),
        "subsampling_3d": ("3D corner error and true error of every run.", lambda: study_3d(study)),
    }
    return _publish(out, "subsampling.html", "How few photos are enough", lines, figures, [study_table(study.rows)])


def publish_validation(validation: Validation, out: Path) -> list[Path]:
    """Write ``validation.html``, ``validation.md`` and the figures as PNG and SVG; the paths written."""
    from specimap_validation.figures import validation_corners, validation_error, validation_sigma

    lines = [
        in_words(validation),
        "The 2D and 3D corner errors are the published ones: cube corners against the run's own reconstruction. "
        "The error of a left-out marker comes from a registration that did not know it. The true error is the distance "
        "between the place where a spectrum of the specimen was put and the place where it was measured, with the "
        "corners fitted without scale.",
    ]
    figures = {
        "validation_error": ("True error of every run.", lambda: validation_error(validation)),
        "validation_corners": ("Corner errors of every run.", lambda: validation_corners(validation)),
        "validation_sigma": ("How reliable the stated uncertainty is.", lambda: validation_sigma(validation)),
    }
    tables = validation_tables(validation)
    text = out / "validation.md"
    write_text(text, markdown(validation) + "\n")
    return [text, *_publish(out, "validation.html", "Validation against truth", lines, figures, tables)]


def markdown(validation: Validation) -> str:
    """The tables as they go into the documentation."""
    tables = (f"{table.title}:\n\n{table.markdown()}" for table in validation_tables(validation))
    return "\n\n".join([in_words(validation), *tables])


def _publish(
    out: Path,
    name: str,
    title: str,
    lines: list[str],
    figures: dict[str, tuple[str, Callable[[], Figure]]],
    tables: list[Table],
) -> list[Path]:
    written, drawn = [], []
    for stem, (caption, draw) in figures.items():
        made = draw()
        text = svg(made)
        drawn.append(Drawn(caption, text[text.index("<svg") :]))
        write_text(out / f"{stem}.svg", text)
        with atomic_path(out / f"{stem}.png") as aside:
            aside.write_bytes(png(made, PRINT_DPI))
        written += [out / f"{stem}.svg", out / f"{stem}.png"]
    write_text(out / name, _page(title, lines, drawn, tables))
    return [out / name, *written]


def _page(title: str, lines: list[str], figures: list[Drawn], tables: list[Table]) -> str:
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError as error:
        raise BackendUnavailableError(
            "Pages need jinja2, which is not installed.", advice="Install specimap[pipeline]."
        ) from error
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(title=title, lines=lines, figures=figures, tables=tables)

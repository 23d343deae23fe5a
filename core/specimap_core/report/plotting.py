"""Figures drawn without a screen and without shared state: sizes, fonts, colours, and the way to bytes.

Figures are matplotlib's objects (``Figure`` with an Agg canvas): nothing is registered with ``pyplot``, so that threads
draw side by side and nothing stays behind. Styles are set on each figure, never in the program's global settings.
"""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from specimap_core.arrays import Array
from specimap_core.errors import BackendUnavailableError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

WIDTH_IN = 7.5
"""Width of a figure across a page, inches; at 96 dots per inch 720 CSS pixels."""
FONT_PT = 9.0
SMALL_PT = 8.0
"""No text is smaller: 8 pt are 10.7 CSS pixels, legible at a zoom of 100 %."""
SCREEN_DPI = 144
PRINT_DPI = 170

INK = "#1b1b1b"
MUTED = "#5a5a5a"
RULE = "#d0d0d0"
# Okabe and Ito (2008): distinguishable with any common colour vision, and in grey print by their order.
BLUE, ORANGE, GREEN, VERMILION = "#0072b2", "#e69f00", "#009e73", "#d55e00"
SKY, PURPLE, YELLOW, BLACK = "#56b4e9", "#cc79a7", "#f0e442", "#000000"
PALETTE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, BLACK, YELLOW)

HEIGHTS = "viridis"
"""Colour map of signed or absolute heights."""
ERRORS = "cividis"
"""Colour map of errors and standard deviations: lighter is worse, also in grey."""
COUNTS = "viridis"
DIFFERENCES = "RdBu_r"
"""Colour map of signed differences; its middle must be zero."""
NOTHING = "#f2f2f2"
"""Where there is no value."""

_SALT = "specimap"
_svg_lock = threading.Lock()


def quiet_matplotlib() -> None:
    """Keep matplotlib's notes from the user: its first import tells of its font list's first build, or of a read-only
    home. Called before that import."""
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def figure(width_in: float = WIDTH_IN, height_in: float = 3.2) -> Figure:
    """An empty figure, inches, laid out so that labels neither overlap nor get cut.

    Raises:
        BackendUnavailableError: matplotlib is not installed.
    """
    quiet_matplotlib()
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise BackendUnavailableError(
            "Figures need matplotlib, which is not installed.", advice="Install specimap[pipeline]."
        ) from error
    made = Figure(figsize=(width_in, height_in), facecolor="white", layout="constrained")
    FigureCanvasAgg(made)
    return made


def styled(ax: Axes, *, title: str = "", x: str = "", y: str = "", grid: bool = True) -> Axes:
    """The house style on axes: titles at the left, thin rules, no box. Label texts carry their units."""
    ax.set_title(title, loc="left", fontsize=FONT_PT + 0.5, color=INK, fontweight="bold")
    ax.set_xlabel(x, fontsize=FONT_PT, color=INK)
    ax.set_ylabel(y, fontsize=FONT_PT, color=INK)
    ax.tick_params(labelsize=SMALL_PT, colors=MUTED, length=3, width=0.6)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set(color=RULE, linewidth=0.8)
    if grid:
        ax.grid(True, color=RULE, linewidth=0.5)
        ax.set_axisbelow(True)
    return ax


def legend(ax: Axes, *, columns: int = 1, place: Any = "best") -> None:
    """A legend without a frame; ``place`` as matplotlib's ``loc``."""
    ax.legend(fontsize=SMALL_PT, frameon=False, ncols=columns, loc=place, labelcolor=INK)


def legend_below(figure: Figure, *, columns: int = 3) -> None:
    """One legend under all axes, which make room for it."""
    figure.legend(fontsize=SMALL_PT, frameon=False, ncols=columns, loc="outside lower left", labelcolor=INK)


def bare(ax: Axes, *, title: str = "") -> Axes:
    """Axes of a picture: no ticks, no frame."""
    ax.set_title(title, loc="left", fontsize=FONT_PT + 0.5, color=INK, fontweight="bold")
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_visible(False)
    return ax


def colour_map(name: str) -> Colormap:
    """A perceptual colour map of matplotlib in which missing values (NaN) are light grey."""
    quiet_matplotlib()
    import matplotlib

    return matplotlib.colormaps[name].with_extremes(bad=NOTHING)


def colour_bar(figure: Figure, ax: Axes | Sequence[Axes], mapped: Any, label: str, *, extend: str = "neither") -> None:
    """A colour bar next to ``ax`` for what ``imshow`` or ``scatter`` returned; ``label`` carries the unit."""
    bar = figure.colorbar(mapped, ax=ax, shrink=0.85, pad=0.02, aspect=28, extend=extend)
    bar.set_label(label, fontsize=FONT_PT, color=INK)
    bar.ax.tick_params(labelsize=SMALL_PT, colors=MUTED, length=3, width=0.6)
    bar.outline.set_visible(False)


def limits(values: Array, percent: tuple[float, float] = (1.0, 99.0)) -> tuple[float, float]:
    """Ends of a colour scale: percentiles of the finite values, never equal; (0, 1) where there is none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, percent))
    return (low, high) if high > low else (low, low + max(abs(low) * 1e-3, 1e-6))


def scale_bar(ax: Axes, px_per_mm: float, width_px: float, *, colour: str = INK) -> float:
    """A bar of a round length in mm, about a fifth of the picture's width, at its lower left; the length."""
    wanted = width_px / px_per_mm / 5
    if not np.isfinite(wanted) or wanted <= 0:
        return 0.0
    step = 10.0 ** np.floor(np.log10(wanted))
    length = float(next((m * step for m in (5, 2, 1) if m * step <= wanted), step))
    from matplotlib import patheffects

    halo = [patheffects.withStroke(linewidth=3.5, foreground="white")]
    share = length * px_per_mm / width_px
    ax.plot(
        [0.03, 0.03 + share],
        [0.04, 0.04],
        transform=ax.transAxes,
        color=colour,
        linewidth=2.2,
        solid_capstyle="butt",
        path_effects=halo,
    )
    ax.text(
        0.03 + share / 2,
        0.055,
        f"{length:g} mm",
        transform=ax.transAxes,
        ha="center",
        va="bottom",
        fontsize=SMALL_PT,
        color=colour,
        path_effects=halo,
    )
    return length


def png(figure: Figure, dpi: float = SCREEN_DPI) -> bytes:
    """The figure as PNG; the same figure gives the same bytes."""
    return _raster(figure, "png", dpi, {"metadata": {"Software": None}})


def jpeg(figure: Figure, dpi: float = SCREEN_DPI, quality: int = 85) -> bytes:
    """The figure as JPEG, for photos; the same figure gives the same bytes."""
    return _raster(figure, "jpg", dpi, {"pil_kwargs": {"quality": quality}})


def _raster(figure: Figure, format: Literal["png", "jpg"], dpi: float, more: dict[str, Any]) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format=format, dpi=dpi, **more)
    return out.getvalue()


def svg(figure: Figure) -> str:
    """The figure as SVG with its text as outlines, so that it looks alike without its fonts; no date in it, and ids
    from a fixed salt: the same figure gives the same text."""
    import matplotlib

    out = io.StringIO()
    # Two settings of the SVG writer exist as global ones only; the raster writers do not read them.
    with _svg_lock, matplotlib.rc_context({"svg.hashsalt": _SALT, "svg.fonttype": "path"}):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return out.getvalue()

"""The options of a run as the command line shows them: their meaning is that of ``RunOptions``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from specimap_core.pipeline import options


def _option(name: str) -> Any:
    # The backticks are for pages that know them.
    return typer.Option(help=options.OPTIONS[name].meaning.replace("`", ""))


EdgeMm = Annotated[float, _option("edge_mm")]
Dictionary = Annotated[str, _option("dictionary")]
"""Any name that OpenCV knows: there are more than a job's settings list."""
Method = Annotated[options.Method, _option("method")]
Adjustment = Annotated[options.Adjustment, _option("adjustment")]
FineCellMm = Annotated[float, _option("r_pc")]
CoarseCellMm = Annotated[float, _option("r_reg")]
Backend = Annotated[options.Backend, typer.Option(help="Reconstruction backend; docs/backends.md.")]
Features = Annotated[options.Features, _option("features")]
WorkingPx = Annotated[int, typer.Option(help="Longer side that larger photos are brought to.")]

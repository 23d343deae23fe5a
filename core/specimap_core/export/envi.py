"""ENVI: the spectra on a regular top-view grid, for programs that know cubes but no clouds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.atomic import atomic_path
from specimap_core.cloud import Cloud
from specimap_core.cloud.top_view import TOP_DEPTH_MM, TopView, top_view

# Spectra gathered at a time: bounds memory to some hundred bytes times this times the bands.
_POINTS_TOGETHER = 65536
_CELLS_TOGETHER = 65536


def write_envi(cloud: Cloud, target: Path, *, grid_mm: float) -> Path:
    """Write ``<name>.hdr`` and ``<name>.bil`` (BIL, uint16) for a ``target`` of that name; the header's path.

    A cell's spectrum is the mean over its points at most 1 mm below the highest, where they have a value. A cell
    without one is the data ignore value: 0, or the cloud's own value for none. Values are the cloud's stored ones:
    reflectance * 10000 (``reflectance scale factor``), or what gains and offsets decode.

    The grid is the marker frame's: cell (0, 0)'s centre at (x_min, y_min). ENVI's lines run downward and its
    y upward: the first line is the one of largest y, and ``map info`` ties the last line's first pixel, cell
    (0, 0), to (x_min, y_min), in mm.

    Raises SettingsError for the grid; the rest as ``export_cloud``.
    """
    header = target if target.suffix == ".hdr" else target.with_name(f"{target.name}.hdr")
    view = top_view(cloud, grid_mm)
    with atomic_path(header.with_suffix(".bil")) as aside, open(aside, "wb") as file:
        for lines in _lines_downward(cloud, view):
            file.write(lines.data)
    with atomic_path(header) as aside:
        aside.write_text(_header(cloud, view), encoding="utf-8")
    return header


def _lines_downward(cloud: Cloud, view: TopView) -> Iterator[NDArray[np.uint16]]:
    """Blocks (lines, B, cols) of the file, from the largest y to the smallest."""
    points = np.flatnonzero(view.top)
    points = points[np.argsort(view.cell[points], kind="stable")]
    cells = view.cell[points]
    first_of_row = np.searchsorted(cells, np.arange(view.rows + 1) * view.cols)
    stop = view.rows
    while stop > 0:
        # As many rows as keep memory bounded, and one at least.
        fitting = np.searchsorted(first_of_row, first_of_row[stop] - _POINTS_TOGETHER)
        start = min(stop - 1, max(int(fitting), stop - _CELLS_TOGETHER // view.cols, 0))
        part = slice(first_of_row[start], first_of_row[stop])
        means = np.full(((stop - start) * view.cols, cloud.bands), cloud.fill_value or 0, np.uint16)
        inside, where = points[part], cells[part] - start * view.cols
        # One row of a fine cloud may hold more points than fit: cells are averaged in portions of whole cells.
        for a, b in _portions(where):
            _average(cloud, inside[a:b], where[a:b], means)
        block = means.reshape(stop - start, view.cols, cloud.bands)[::-1]
        yield np.ascontiguousarray(block.transpose(0, 2, 1), "<u2")
        stop = start


def _portions(cells: NDArray[np.int32]) -> Iterator[tuple[int, int]]:
    """Ranges of the sorted ``cells`` (n,) of about the bound, none of which splits a cell."""
    start = 0
    while start < len(cells):
        stop = min(start + _POINTS_TOGETHER, len(cells))
        if stop < len(cells):
            whole = int(np.searchsorted(cells, cells[stop]))
            stop = whole if whole > start else int(np.searchsorted(cells, cells[stop], "right"))
        yield start, stop
        start = stop


def _average(cloud: Cloud, points: NDArray[np.intp], cells: NDArray[np.int32], means: NDArray[np.uint16]) -> None:
    """Set the rows ``cells`` (n, sorted) of ``means`` to the mean spectra of ``points`` (n,)."""
    spectra = cloud.stored_spectra(points)
    firsts = np.flatnonzero(np.diff(cells, prepend=-1))
    counts = np.diff(firsts, append=len(cells))
    alone = firsts[counts == 1]
    means[cells[alone]] = spectra[alone]
    several = counts > 1
    for first, count in zip(firsts[several].tolist(), counts[several].tolist(), strict=True):
        part = spectra[first : first + count]
        if cloud.fill_value is None:
            means[cells[first]] = np.rint(part.mean(0, dtype=np.float32))
            continue
        known = part != cloud.fill_value
        mean = np.where(known, part, 0).sum(0, dtype=np.float32) / np.maximum(known.sum(0), 1)
        means[cells[first]] = np.where(known.any(0), np.rint(mean), cloud.fill_value)


def _header(cloud: Cloud, view: TopView) -> str:
    def listed(values: object) -> str:
        return "{" + ", ".join(f"{value:.7g}" for value in np.asarray(values).tolist()) + "}"

    fields: dict[str, object] = {
        "description": f"{{Specimap: mean of the topmost {TOP_DEPTH_MM:g} mm, marker frame, mm}}",
        "samples": view.cols,
        "lines": view.rows,
        "bands": cloud.bands,
        "header offset": 0,
        "file type": "ENVI Standard",
        "data type": 12,
        "interleave": "bil",
        "byte order": 0,
        "data ignore value": cloud.fill_value or 0,
        # Reference pixel: 1-based, its centre at a half. It is cell (0, 0), in the last line.
        "map info": f"{{Arbitrary, 1.5, {view.rows + 0.5:.1f}, {view.x_min:.6f}, {view.y_min:.6f}, "
        f"{view.grid_mm:g}, {view.grid_mm:g}, units=Millimeters}}",
        "bbl": listed((~cloud.bad_bands).astype(int)),
    }
    if np.isfinite(cloud.wavelengths_nm).all():
        fields |= {"wavelength units": "Nanometers", "wavelength": listed(cloud.wavelengths_nm)}
    if cloud.quantity == "reflectance" and cloud.add_offset == 0:
        fields["reflectance scale factor"] = f"{1 / cloud.scale_factor:.10g}"
    elif cloud.scale_factor != 1 or cloud.add_offset != 0:
        fields["data gain values"] = listed(np.full(cloud.bands, cloud.scale_factor))
        fields["data offset values"] = listed(np.full(cloud.bands, cloud.add_offset))
    return "\n".join(["ENVI", *(f"{key} = {value}" for key, value in fields.items())]) + "\n"

"""Selection of points and bands by a request, and their values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.outline import rows_crossed
from specimap_service.array_responses import Columns
from specimap_service.clouds.spectra_schemas import Bands, FieldName, Place, Select
from specimap_service.errors import RequestInvalidError

MOST_VALUES, MOST_JSON_VALUES = 40_000_000, 4_000_000
"""Values of one page, points times bands: with more bands than usual a page has fewer points."""
MOST_CROSSINGS = 1_000_000
"""Rows that the edges of a polygon cross, all together: a hundred times what an outline drawn by hand has."""
ROUND_VALUES = 2**22
"""Stored values that are read together, 8 MiB: points in any order touch each chunk once a round, not once a batch."""


# ---- selection ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Selection:
    """``indices`` (n,) of the points asked for, ``centre`` (3,) mm of what ``distance_mm`` is measured from."""

    indices: NDArray[np.intp]
    centre: Place | None = None


def selected(cloud: Cloud, select: Select) -> Selection:
    """Find the selected points.

    Raises:
        RequestInvalidError: there is no such point.
    """
    if select.indices is not None:
        return Selection(_checked_numbers(select.indices, cloud.n_points, "point"))
    if select.pixels is not None:
        found = cloud.at_pixels(np.array(select.pixels))
        return Selection(found[found >= 0])
    if select.polygon is not None:
        _check_outline(cloud, select.polygon)
        return Selection(cloud.in_polygon(select.polygon))
    if select.nearest is not None:
        return Selection(cloud.nearest(select.nearest.xyz, select.nearest.k)[0], select.nearest.xyz)
    if select.box is not None:
        return Selection(cloud.in_box(select.box.low, select.box.high))
    assert select.radius is not None
    return Selection(cloud.in_radius(select.radius.centre, select.radius.radius_mm), select.radius.centre)


def _check_outline(cloud: Cloud, polygon: list[tuple[float, float]]) -> None:
    crossed = rows_crossed(np.asarray(polygon, np.float64), int(cloud.hsi_pixel[:, 0].max(initial=0)))
    if crossed > MOST_CROSSINGS:
        raise RequestInvalidError(
            f"The polygon's edges cross {crossed} rows of pixels, more than any outline does.",
            advice=f"Give an outline with fewer turns: its edges may cross {MOST_CROSSINGS} rows all together.",
            limit=MOST_CROSSINGS,
        )


def band_numbers(cloud: Cloud, bands: Bands | None) -> NDArray[np.intp] | None:
    """Find the selected bands; None stands for all.

    Raises:
        RequestInvalidError: there is no such band.
    """
    if bands is None:
        return None
    if bands.indices is not None:
        return _checked_numbers(bands.indices, cloud.bands, "band")
    assert bands.nm is not None
    low, high = bands.nm
    # Unknown wavelengths are NaN, which lies in no range.
    found = np.flatnonzero((cloud.wavelengths_nm >= low) & (cloud.wavelengths_nm <= high))
    if not len(found):
        known = cloud.wavelengths_nm[np.isfinite(cloud.wavelengths_nm)]
        span = f"from {known.min():g} to {known.max():g} nm" if len(known) else "of unknown wavelength"
        raise RequestInvalidError(
            f"No band lies between {low:g} and {high:g} nm; the cloud's are {span}.",
            advice="Give a range that holds a band, or bands by number.",
        )
    return found


def listed_bands(text: str | None) -> Bands | None:
    """Parse bands from the query: ``0,5,10-20``, the form of which has been checked."""
    if text is None:
        return None
    numbers: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        wanted = range(int(first), int(last or first) + 1)
        if not wanted or len(numbers) + len(wanted) > 65536:
            raise RequestInvalidError(
                "query.bands: a range is empty, or there are too many.", advice="Give numbers as in 0,5,10-20."
            )
        numbers += wanted
    if len(set(numbers)) < len(numbers):
        raise RequestInvalidError("query.bands: a band is named twice.", advice="Give each band once.")
    return Bands(indices=numbers)


def _checked_numbers(numbers: list[int], limit: int, what: str) -> NDArray[np.intp]:
    found = np.array(numbers, np.intp)
    if found.max() >= limit:
        raise RequestInvalidError(
            f"There is no {what} {found.max()}: the cloud has {limit}.",
            advice=f"Give numbers from 0 to {limit - 1}.",
            limit=limit,
        )
    return found


# ---- values -------------------------------------------------------------------------------------------


class PointSpectra:
    """Spectra of points in any order, read a round at a time as the rows are asked for."""

    def __init__(self, cloud: Cloud, points: NDArray[np.intp], bands: NDArray[np.intp] | None) -> None:
        self._cloud, self._points, self._bands = cloud, points, bands
        self.width = cloud.bands if bands is None else len(bands)
        self._round = max(1, ROUND_VALUES // max(self.width, 1))
        self._start, self._stored = 0, np.empty((0, self.width), np.uint16)

    def __len__(self) -> int:
        return len(self._points)

    def read(self, start: int, stop: int) -> NDArray[np.float32]:
        """Return decoded spectra (stop - start, bands) of some of the points. Raises CloudDamagedError."""
        if not self._start <= start <= stop <= self._start + len(self._stored):
            end = max(stop, min(start + self._round, len(self._points)))
            # The old round goes first: two of them are never in memory.
            self._stored = np.empty((0, self.width), np.uint16)
            self._start, self._stored = start, self._cloud.stored_spectra(self._points[start:end], self._bands)
        return self._cloud.decode(self._stored[start - self._start : stop - self._start])


def field_values(cloud: Cloud, selection: Selection, name: FieldName, part: slice) -> Array:
    """Return values (n,) or (n, m) of a field for a part of the selected points."""
    points = selection.indices[part]
    if name != "distance_mm":
        return np.asarray(getattr(cloud, name)[points])
    return np.asarray(np.linalg.norm(cloud.xyz[points] - np.asarray(selection.centre), axis=1), np.float32)


def columns_of(
    cloud: Cloud, page: Selection, spectra: PointSpectra, fields: list[FieldName], start: int, stop: int
) -> Columns:
    """Return the columns of an Arrow stream for some points of a page: index, the fields, spectrum."""
    part = slice(start, stop)
    return {
        "index": page.indices[part].astype(np.uint32),
        **{name: field_values(cloud, page, name, part) for name in fields},
        "spectrum": spectra.read(start, stop),
    }


def flag_names(flags: int) -> list[str]:
    """Return the names of the bits that are set."""
    return [flag.name.lower() for flag in Flag if flag.name and flags & flag]

"""Find markers in the cube: in the band mean, else in bands where they show; mirrored cubes are recognised."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.errors import DuplicateMarkersError, MarkersMissingInCubeError
from specimap_core.fiducials.detection import Detection, detect_markers

LEAST_MARKERS = 2
WINDOWS = 6
"""Parts of the spectrum that are tried, and single bands within them, where the mean does not show markers."""
ABSURD_SPANS = 3.0
"""What lies so many spans of the usual values beyond them is a dead pixel."""
WIDE_HOLE_PX = 7
"""Holes from this width on are no dead columns: nothing was recorded there."""
_AROUND = np.array([[0.5, 1, 0.5], [1, 0, 1], [0.5, 1, 0.5]], np.float32)


class Bands(Protocol):
    """What the search needs of a cube."""

    @property
    def cols(self) -> int:
        """Columns."""
        ...

    @property
    def bands(self) -> int:
        """Bands."""
        ...

    @property
    def wavelengths_nm(self) -> Floats:
        """(bands,), NaN where unknown."""
        ...

    @property
    def bad_bands(self) -> NDArray[np.bool_]:
        """(bands,)."""
        ...

    def band(self, index: int) -> Array:
        """One band (rows, cols)."""
        ...

    def mean_image(self, bands: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Mean over the bands (rows, cols)."""
        ...


@dataclass(frozen=True)
class CubeMarkers:
    """Corners of the known markers in the cube.

    ``corners_px`` (Q, 4, 2) x (column), y (row) of ``marker_ids``; ``sigma_px`` (Q,); ``image`` (rows, cols) in
    which they were found, as :func:`cleaned` gives it;
    ``where``: in words; ``mirrored``: the cube's columns run the wrong way round, corners
    are given in its own columns all the same.
    """

    marker_ids: tuple[int, ...]
    corners_px: Floats
    sigma_px: Floats
    image: NDArray[np.float32]
    where: str
    mirrored: bool


def unmirrored(pixels: Floats, mirrored: bool, cols: int) -> Floats:
    """Pixels (..., 2) x, y of a cube of ``cols`` columns as its camera saw them, or those of the camera as the cube's:
    the same, with x counted from the other side where the cube is ``mirrored``."""
    if not mirrored:
        return pixels
    flipped = pixels.copy()
    flipped[..., 0] = cols - 1 - flipped[..., 0]
    return flipped


def cleaned(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """A linear image (rows, cols) without dead pixels and columns; where a larger part has no value it stays NaN.

    Values far outside of all others count as none; holes up to six pixels wide take on what surrounds them.
    """
    image = np.where(np.isfinite(image), image, np.nan).astype(np.float32)
    if not np.isfinite(image).any():
        return image
    low, high = _stretch(image)
    reach = ABSURD_SPANS * (high - low)
    image[(image > high + reach) | (image < low - reach)] = np.nan
    holes = np.isnan(image)
    if not holes.any():
        return image
    square = np.ones((WIDE_HOLE_PX, WIDE_HOLE_PX), np.uint8)
    large = cv2.morphologyEx(holes.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    for _ in range(WIDE_HOLE_PX // 2):
        known = np.isfinite(image)
        weight = cv2.filter2D(known.astype(np.float32), -1, _AROUND, borderType=cv2.BORDER_CONSTANT)
        total = cv2.filter2D(np.where(known, image, np.float32(0)), -1, _AROUND, borderType=cv2.BORDER_CONSTANT)
        reached = ~known & ~large & (weight > 0)
        image[reached] = total[reached] / weight[reached]
    return image


def _stretch(image: NDArray[np.float32]) -> tuple[float, float]:
    """The 0.5th and 99.5th percentile of the finite values."""
    finite = image[np.isfinite(image)]
    low, high = np.percentile(finite[:: max(1, finite.size // 200_000)].astype(np.float64), [0.5, 99.5])
    return float(low), float(high)


def stretched(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """0.5-99.5 % of the finite values to bytes, encoded as sRGB would, which detection expects."""
    if not np.isfinite(image).any():
        return np.zeros(image.shape, np.uint8)
    low, high = _stretch(image)
    # Wide: differences of float32 at the ends of their range do not fit float32.
    wide = np.nan_to_num(image.astype(np.float64), nan=low, posinf=high, neginf=low)
    scaled = np.clip((wide - low) / max(high - low, 1e-12), 0, 1)
    return np.asarray(255 * np.sqrt(scaled), np.uint8)


def find_in_image(image: NDArray[np.float32], dictionary: str, known: tuple[int, ...]) -> list[Detection]:
    """Known markers in a linear image (rows, cols)."""
    finite = np.isfinite(image)
    filled = np.where(finite, image, np.float32(image[finite].mean() if finite.any() else 0)).astype(np.float32)
    grey = stretched(filled)
    found = detect_markers(grey, dictionary, expected=len(known), linear=filled)
    if len({d.marker_id for d in found} & set(known)) < min(len(known), 4):
        # Dead pixels and noise hide bits; a small median gives them back, corners come from the real image.
        calm = cv2.medianBlur(grey, 3)
        found += [
            d
            for d in detect_markers(calm, dictionary, expected=0, linear=filled)
            if d.marker_id not in {f.marker_id for f in found}
        ]
    return [d for d in found if d.marker_id in known]


def find_markers(cube: Bands, dictionary: str, known: tuple[int, ...]) -> CubeMarkers:
    """Find the markers that the photos know.

    Raises:
        MarkersMissingInCubeError: fewer than two show, in any band tried, mirrored or not; details say which ids
            were seen and which were looked for.
        DuplicateMarkersError: an id stands twice in the cube.
    """
    mean = cube.mean_image()
    best: tuple[list[Detection], NDArray[np.float32], str, bool] = ([], mean, "band mean", False)
    enough = min(len(known), 4)
    for raw, where in _candidates(cube, mean):
        image = cleaned(raw)
        for mirrored in (False, True):
            seen = image[:, ::-1] if mirrored else image
            found = find_in_image(np.ascontiguousarray(seen), dictionary, known)
            if len({d.marker_id for d in found}) > len({d.marker_id for d in best[0]}):
                best = (found, image, where, mirrored)
            if best[0]:
                break
        if len({d.marker_id for d in best[0]}) >= enough:
            break
    found, image, where, mirrored = best
    ids = [d.marker_id for d in found]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise DuplicateMarkersError(
            f"Marker id {', '.join(map(str, twice))} stands twice in the cube.",
            advice="Give every marker around the specimen an id of its own.",
            ids=twice,
        )
    if len(ids) < LEAST_MARKERS:
        raise MarkersMissingInCubeError(
            f"{len(ids)} of {len(known)} markers show in the cube; at least {LEAST_MARKERS} are needed.",
            advice="Record the cube again with the markers in view, lit and in focus, and not covered.",
            seen=ids,
            wanted=list(known),
        )
    corners = unmirrored(np.stack([d.corners_px for d in found]), mirrored, cube.cols)
    return CubeMarkers(tuple(ids), corners, np.array([d.sigma_px for d in found]), image, where, mirrored)


def _candidates(cube: Bands, mean: NDArray[np.float32]) -> Iterator[tuple[NDArray[np.float32], str]]:
    """The mean, then windows of the spectrum, then single bands, each with its name."""
    yield mean, "band mean"
    good = np.flatnonzero(~cube.bad_bands)
    if len(good) < 2:
        return
    for part in np.array_split(good, min(WINDOWS, len(good))):
        chosen = np.zeros(cube.bands, bool)
        chosen[part] = True
        yield cube.mean_image(chosen), f"mean of {_span(cube, int(part[0]), int(part[-1]))}"
    for index in good[:: max(1, len(good) // (2 * WINDOWS))]:
        yield cube.band(int(index)).astype(np.float32), f"band {_span(cube, int(index), int(index))}"


def _span(cube: Bands, first: int, last: int) -> str:
    low, high = cube.wavelengths_nm[first], cube.wavelengths_nm[last]
    if not np.isfinite([low, high]).all():
        return f"{first}" if first == last else f"{first}-{last}"
    return f"{low:.0f} nm" if first == last else f"{low:.0f}-{high:.0f} nm"

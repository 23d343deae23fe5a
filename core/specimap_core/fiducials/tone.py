"""The tone of photos: in which light their edges lie where they are.

An edge blurred in linear light, by the lens and the pixels, keeps its place there. What a camera or a program does to
the encoded values afterwards (enlarging, shrinking, smoothing, a tone curve of its own) blurs it once more, and what is
dark in linear light spreads: markers grow by up to a pixel. Where between the two a photo stands, its markers tell,
since their black and white cells are of one size.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np

from specimap_core.arrays import Floats, Singles
from specimap_core.fiducials.subpixel import edge_positions, outward_normals

TRIALS = 1.0, 0.6
"""Powers of linear light at which cells are measured; between and a little beyond them the shift is a straight line."""
RANGE = 0.4, 1.25
"""From sRGB's own encoding to a white that blooms."""
LEAST_CELLS = 60
"""Borders of cells that must have been measured."""
LEAST_CELL_PX = 4.0
LEAST_LEVER = 0.5
PROFILES = 9
PROFILE_MARGIN = 0.25
"""Share of a cell's side left out at either end."""
REACH_CELLS = 0.4
BATCH = 32


@cache
def cell_borders(dictionary: int, marker_id: int) -> tuple[Floats, Floats]:
    """Borders between black and white cells inside a marker: ends and the middle of the black cell, (K, 3, 2) in cells
    from its top-left corner, and levers (K,), by which a growth of all that is black shifts them against the corners.
    """
    pattern = cv2.aruco.getPredefinedDictionary(dictionary)
    n = pattern.markerSize + 2
    white = cv2.aruco.generateImageMarker(pattern, marker_id, n) > 127
    borders, levers = [], []
    for cells, turn in ((white, 1), (white.T, -1)):
        for row, column in np.argwhere(cells[:, 1:] != cells[:, :-1]):
            side = 1 if cells[row, column + 1] else -1
            x = column + 1
            places = np.array([[x, row], [x, row + 1], [x - side / 2, row + 0.5]], float)
            borders.append(places[:, ::turn])
            # The corners, from which it is measured, have moved as well: outward, in proportion.
            levers.append(1 - side * (2 * x / n - 1))
    return np.array(borders).reshape(-1, 3, 2) / n, np.array(levers, float)


def shift_of_cells(light: Singles, squares: Floats, marker_ids: Sequence[int], dictionary: int) -> Floats:
    """By how many pixels black has grown at each border between cells of markers, (K,), those left out that tell
    nothing; ``squares`` (N, 4, 2): their corners as measured in the same ``light`` (H, W)."""
    ends, levers = [], []
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    for square, marker_id in zip(squares, marker_ids, strict=True):
        borders, lever = cell_borders(dictionary, marker_id)
        H = cv2.getPerspectiveTransform(unit, square.astype(np.float32))
        ends.append(cv2.perspectiveTransform(borders.reshape(1, -1, 2), H).reshape(-1, 3, 2))
        levers.append(lever)
    if not ends:
        return np.zeros(0)
    places, lever = np.concatenate(ends), np.concatenate(levers)
    length = np.linalg.norm(places[:, 1] - places[:, 0], axis=1)
    usable = (lever >= LEAST_LEVER) & (length >= LEAST_CELL_PX)
    (a, b, black), lever, length = np.moveaxis(places[usable], 1, 0), lever[usable], length[usable]
    if not len(a):
        return np.zeros(0)
    along, normal, depth = outward_normals(a, b, black)
    s = np.linspace(PROFILE_MARGIN, 1 - PROFILE_MARGIN, PROFILES) * length[:, None]
    reach = 2 * REACH_CELLS * depth
    shift = np.full(len(a), np.nan)
    for some in np.array_split(np.argsort(reach), -(-len(a) // BATCH)):
        found, clear, _ = edge_positions(light, a[some], along[some], normal[some], s[some], reach[some])
        enough = clear.sum(1) > PROFILES // 2
        shift[some[enough]] = np.nanmedian(np.where(clear, found, np.nan)[enough], axis=1)
    return np.asarray((shift / lever)[np.isfinite(shift)])


def tone_between(shifts: Sequence[Floats]) -> float:
    """The power of linear light at which black has not grown; ``shifts``: the growths at each of ``TRIALS``. One where
    they tell too little."""
    if min(map(len, shifts)) < LEAST_CELLS:
        return 1.0
    first, second = (float(np.median(shift)) for shift in shifts)
    if first <= second:
        return 1.0
    tone = TRIALS[0] - first * (TRIALS[0] - TRIALS[1]) / (first - second)
    return float(np.clip(tone, *RANGE))

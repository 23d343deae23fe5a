"""Divide a surface into specimen, marker card and tray, by height and by the markers' layout."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats

CARD_OVER_MARKER = 1.5
"""Edge of a card over that of its marker (10.2 mm over 6.8 mm in the published layout)."""


CARD_HEIGHT_MM = 1.0


SPECIMEN_HEIGHT_SHARE = 0.012
"""A specimen's points rise above the marker plane by more than this share of the layout's diagonal."""


SAMPLE = 500
"""Places that stand for a specimen's surface."""


def on_card(xyz: NDArray[np.float32], corners: Floats) -> NDArray[np.bool_]:
    """Whether points (S, 3) lie on one of the cards, whose markers have corners (Q, 4, 3) mm."""
    found = np.zeros(len(xyz), bool)
    for square in corners:
        centre = square.mean(0)
        x, y = square[1] - square[0], square[0] - square[3]
        half = float(np.linalg.norm(x)) / 2 * CARD_OVER_MARKER
        away = xyz - centre
        u, v = away @ (x / np.linalg.norm(x)), away @ (y / np.linalg.norm(y))
        w = away @ (np.cross(x, y) / np.linalg.norm(np.cross(x, y)))
        found |= (np.abs(u) < half) & (np.abs(v) < half) & (np.abs(w) < CARD_HEIGHT_MM)
    return found


def worth_refining(vertices: NDArray[np.float32], corners: Floats) -> NDArray[np.bool_]:
    """Whether vertices (V, 3) mm may be of the specimen or of a card: the plain tray is most of a mesh, and nobody
    asks for its third digit."""
    return np.asarray((vertices[:, 2] > raised_mm(corners) / 2) | on_card(vertices, corners))


def raised_mm(corners: Floats) -> float:
    """Height above the marker plane from which on something is the specimen."""
    return SPECIMEN_HEIGHT_SHARE * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))


def raised_places(vertices: NDArray[np.float32], corners: Floats) -> Floats:
    """Some hundred of the vertices (V, 3) mm that rise as a specimen does, (N, 3) mm."""
    raised = vertices[vertices[:, 2] > raised_mm(corners)].astype(float)
    return raised[:: max(1, len(raised) // SAMPLE)]


def on_specimen(
    pixels: NDArray[np.uint16], xyz: NDArray[np.float32], card: NDArray[np.bool_], corners: Floats
) -> NDArray[np.bool_]:
    """Whether points (S, 3) of cube pixels (S, 2) are of the specimen: the largest raised part between the cards,
    with what touches it in the cube."""
    if not len(xyz):
        return np.zeros(0, bool)
    raised = (xyz[:, 2] > raised_mm(corners)) & ~card
    shape = pixels.max(0).astype(int) + 1
    mask = np.zeros(shape, np.uint8)
    mask[pixels[raised, 0], pixels[raised, 1]] = 1
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, parts, statistics, _ = cv2.connectedComponentsWithStats(mask)
    if len(statistics) < 2:
        return np.zeros(len(xyz), bool)
    largest = int(statistics[1:, cv2.CC_STAT_AREA].argmax()) + 1
    return np.asarray((parts[pixels[:, 0], pixels[:, 1]] == largest) & ~card)

"""Cards as meshes, so that they can be bent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_validation.path_traced.settings import TracedSettings
from specimap_validation.phantom.scene import place_cards
from specimap_validation.phantom.settings import Stream
from specimap_validation.phantom.specimen import TRAY_Z_MM

MARGIN = 1 / 6
"""Width of a card's white margin over the card's."""
_CELLS = 12  # a multiple of 6, so that the markers' corners are vertices
_CLEAR_MM = 0.02


@dataclass(frozen=True)
class CardMeshes:
    """Cards as one mesh.

    ``corners`` (N, 4, 3) mm of the markers: top-left, top-right, bottom-right, bottom-left. ``vertices`` (V, 3) mm and
    ``triangles`` (T, 3), as many for each card. ``uv`` (V, 2): place on the card, to the right and down, 0..1.
    ``white`` (N, n, n): the markers' cells.
    """

    corners: Floats
    vertices: Floats
    triangles: NDArray[np.int32]
    uv: Floats
    white: NDArray[np.bool_]

    @property
    def triangles_per_card(self) -> int:
        """As many triangles, one after the other, are one card."""
        return len(self.triangles) // len(self.corners)


def bent_cards(settings: TracedSettings) -> CardMeshes:
    """Place the cards as a quick phantom's are, then bend each about a direction of its own."""
    flat = place_cards(settings)
    rng = settings.rng(Stream.CARDS, 1)
    n = _CELLS
    steps = np.linspace(0, 1, n + 1)
    uv = np.stack([a.ravel() for a in np.meshgrid(steps, steps)], 1)
    row, col = (a.ravel() for a in np.indices((n, n)))
    corner = row * (n + 1) + col
    quad = np.stack([corner, corner + n + 1, corner + n + 2, corner + 1], 1)
    cell = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    low, high = round(n * MARGIN), n - round(n * MARGIN)
    vertices, corners = [], []
    for outline in flat.outlines:
        along, down = outline[1] - outline[0], outline[3] - outline[0]
        normal = np.cross(down, along)
        normal /= np.linalg.norm(normal)
        angle, share, way = rng.uniform(0, np.pi), rng.uniform(0.5, 1), rng.choice([-1, 1])
        across = (2 * uv - 1) @ np.array([np.cos(angle), np.sin(angle)])
        bend = settings.card_bend_mm * share * way * (across**2 - 1 / 3)
        card = outline[0] + uv[:, :1] * along + uv[:, 1:] * down + bend[:, None] * normal
        card[:, 2] += max(TRAY_Z_MM + _CLEAR_MM - card[:, 2].min(), 0.0)
        vertices.append(card)
        corners.append(card.reshape(n + 1, n + 1, 3)[[low, low, high, high], [low, high, high, low]])
    triangles = np.concatenate([cell + k * len(uv) for k in range(len(vertices))]).astype(np.int32)
    return CardMeshes(
        np.stack(corners), np.concatenate(vertices), triangles, np.tile(uv, (len(vertices), 1)), flat.white
    )

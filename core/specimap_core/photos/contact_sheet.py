"""A contact sheet: small tiles of the used photos in one JPEG, to draw corners on when the photos are gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Bytes
from specimap_core.errors import PhotoUnreadableError

TILE_PX = 256
"""Longer side of a tile."""
_QUALITY = 85


@dataclass(frozen=True)
class SheetLayout:
    """Where tiles lie: row by row from the top left, ``columns`` a row, each ``tile_width_px`` x ``tile_height_px``.

    ``scale``: tile pixels over photo pixels; the photo's (x, y), pixel centres at integers, is the tile's
    ((x, y) + 0.5) * scale - 0.5.
    """

    count: int
    columns: int
    tile_width_px: int
    tile_height_px: int

    @classmethod
    def of(cls, count: int, width_px: int, height_px: int) -> SheetLayout:
        """The layout of ``count`` photos of one size; photos smaller than a tile are not enlarged."""
        scale = min(1.0, TILE_PX / max(width_px, height_px))
        tile = max(1, round(width_px * scale)), max(1, round(height_px * scale))
        # About as high as wide, whatever the photos' shape.
        columns = max(1, round(float(np.sqrt(count * tile[1] / tile[0]))))
        return cls(count, columns, *tile)

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-self.count // self.columns)

    def place(self, k: int) -> tuple[slice, slice]:
        """Rows and columns of pixels of the ``k``-th tile."""
        row, column = divmod(k, self.columns)
        return (
            slice(row * self.tile_height_px, (row + 1) * self.tile_height_px),
            slice(column * self.tile_width_px, (column + 1) * self.tile_width_px),
        )


def contact_sheet(images: Sequence[Bytes]) -> bytes:
    """Photos of one size, (H, W, 3) RGB or (H, W) grey, as one JPEG; empty where there is none."""
    import cv2

    if not images:
        return b""
    height, width = images[0].shape[:2]
    layout = SheetLayout.of(len(images), width, height)
    sheet = np.full((layout.rows * layout.tile_height_px, layout.columns * layout.tile_width_px, 3), 255, np.uint8)
    for k, image in enumerate(images):
        tile = cv2.resize(image, (layout.tile_width_px, layout.tile_height_px), interpolation=cv2.INTER_AREA)
        sheet[layout.place(k)] = tile[..., None] if tile.ndim == 2 else tile
    done, jpeg = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a JPEG")
    return jpeg.tobytes()


def read_tiles(data: bytes, count: int, width_px: int, height_px: int) -> list[Bytes]:
    """The tiles (h, w, 3) RGB of ``count`` photos of ``width_px`` x ``height_px``, from a sheet's JPEG.

    Raises:
        PhotoUnreadableError: it is no JPEG, or of other photos.
    """
    import cv2

    layout = SheetLayout.of(count, width_px, height_px)
    expected = layout.rows * layout.tile_height_px, layout.columns * layout.tile_width_px
    sheet = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if sheet is None or sheet.shape[:2] != expected:
        raise PhotoUnreadableError(
            "The contact sheet of the photos does not fit the report.", advice="Repeat the run, or go without it."
        )
    return [np.ascontiguousarray(sheet[layout.place(k)][..., ::-1]) for k in range(count)]

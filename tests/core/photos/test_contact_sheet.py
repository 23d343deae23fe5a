"""The contact sheet: each photo's tile where the layout says, and refused where it is not of these photos."""

from __future__ import annotations

import numpy as np
import pytest

from specimap_core.errors import PhotoUnreadableError
from specimap_core.photos.contact_sheet import TILE_PX, SheetLayout, contact_sheet, read_tiles

JPEG_STEPS = 12
"""Colours of even fields come back within the quantisation of JPEG at this quality, also across the tiles' borders."""


@pytest.mark.parametrize(("count", "width", "height"), [(1, 100, 80), (7, 640, 480), (24, 512, 512), (42, 480, 1280)])
def test_tiles_come_back_in_order(count: int, width: int, height: int) -> None:
    rng = np.random.default_rng(count)
    colours = rng.integers(30, 226, (count, 3), dtype=np.uint8)
    images = [np.full((height, width, 3), colour, np.uint8) for colour in colours]
    tiles = read_tiles(contact_sheet(images), count, width, height)
    assert len(tiles) == count
    layout = SheetLayout.of(count, width, height)
    assert max(layout.tile_width_px, layout.tile_height_px) == min(TILE_PX, max(width, height))
    assert abs(layout.tile_width_px / layout.tile_height_px - width / height) < 0.02 * width / height
    for tile, colour in zip(tiles, colours, strict=True):
        assert tile.shape == (layout.tile_height_px, layout.tile_width_px, 3)
        middle = np.median(tile.reshape(-1, 3), axis=0)
        assert np.abs(middle - colour).max() <= JPEG_STEPS


def test_a_place_in_a_photo_is_where_the_scale_puts_it() -> None:
    image = np.zeros((1024, 1024, 3), np.uint8)
    image[600:640, 200:240] = 255
    tile = read_tiles(contact_sheet([image]), 1, 1024, 1024)[0].mean(2)
    rows, cols = np.nonzero(tile > 127)
    # The white field spans photo pixels 200 to 239: its middle is at (219.5 + 0.5) / 4 - 0.5 of the tile.
    assert abs(cols.mean() - 54.5) <= 0.5
    assert abs(rows.mean() - 154.5) <= 0.5


def test_grey_photos_and_none() -> None:
    grey = np.full((60, 80), 120, np.uint8)
    tiles = read_tiles(contact_sheet([grey, grey]), 2, 80, 60)
    assert np.abs(tiles[1].astype(int) - 120).max() <= JPEG_STEPS
    assert contact_sheet([]) == b""


@pytest.mark.parametrize(("count", "width", "height"), [(9, 80, 60), (2, 60, 80)])
def test_a_sheet_of_other_photos_is_refused(count: int, width: int, height: int) -> None:
    data = contact_sheet([np.zeros((60, 80), np.uint8)] * 2)
    with pytest.raises(PhotoUnreadableError):
        read_tiles(data, count, width, height)
    for broken in (b"", b"no jpeg", data[:40]):
        with pytest.raises(PhotoUnreadableError):
            read_tiles(broken, 2, 80, 60)

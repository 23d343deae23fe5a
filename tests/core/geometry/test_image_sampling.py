"""Looking images up between their pixels: any number of places, images of any size, whose values are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.geometry.image_sampling import MOST, ROW, sample

STEP = 1 / 32
"""OpenCV rounds places to this."""


def ramp(rows: int, cols: int) -> NDArray[np.float32]:
    """Rises by 1 a column and by 3 a row, so that what lies between pixels is known."""
    return (np.arange(cols) + 3.0 * np.arange(rows)[:, None]).astype(np.float32)


@pytest.mark.parametrize("count", [0, 1, 2, ROW, ROW + 1, MOST, MOST + 1, 40_000, 3 * MOST])
def test_any_number_of_places(count: int) -> None:
    rng = np.random.default_rng(count)
    x, y = rng.uniform(3, 50, count), rng.uniform(3, 35, count)
    found = sample(ramp(40, 60), x, y)
    assert found.shape == (count,)
    assert np.abs(found - (x + 3 * y)).max(initial=0) <= 4 * STEP


def test_interpolation_is_what_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((30, 40), np.float32)
    x, y = (rng.uniform(4, top, MOST + 9).astype(np.float32) for top in (35, 25))
    for kind in (cv2.INTER_NEAREST, cv2.INTER_LINEAR, cv2.INTER_CUBIC):
        parts = np.array_split(np.arange(len(x)), 9)
        pieces = [cv2.remap(image, x[None, part], y[None, part], kind) for part in parts]
        assert np.allclose(sample(image, x, y, kind), np.concatenate(pieces, axis=1)[0], atol=1e-5)


@pytest.mark.parametrize("shape", [(MOST + 10, 3), (3, MOST + 10), (7, 5, 4), (40_000, 1), (0, 9)])
def test_any_shape(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(1, 50, shape), rng.uniform(1, 35, shape)
    found = sample(ramp(40, 60), x, y)
    assert found.shape == shape
    assert np.abs(found - (x + 3 * y)).max(initial=0) <= 4 * STEP


@pytest.mark.parametrize("shape", [(MOST + 5000, 12), (12, MOST + 5000), (2 * MOST + 7, 9)])
def test_images_larger_than_one_call_takes(shape: tuple[int, int]) -> None:
    image = (np.arange(shape[0]) % 97)[:, None] * 3.0 + np.arange(shape[1]) % 89
    y, x = (g.ravel().astype(float) for g in np.indices(shape))
    assert (sample(image.astype(np.float32), x, y) == image.ravel()).all()


def test_nothing_shows_outside() -> None:
    assert sample(ramp(8, 8) + 5, np.array([-3.0, 20.0, 3.0]), np.array([3.0, 3.0, -9.0])).tolist() == [0, 0, 0]

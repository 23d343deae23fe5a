"""The interface of all kinds of image features."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.photos.reading import Photo

Pairs = NDArray[np.int64]


A = TypeVar("A")


B = TypeVar("B")


@dataclass(frozen=True)
class Features:
    """``xy`` (N, 2) pixels with centres at integers; ``descriptors`` (N, 128) float32 of unit length.

    ``size``: width, height of the photo. ``quarter_turns``: by how many, clockwise, the photo was turned when it was
    described; ``xy`` refers to the photo as given.
    """

    xy: Floats
    descriptors: NDArray[np.float32]
    size: tuple[int, int] = (0, 0)
    quarter_turns: int = 0


class FeatureKind(Protocol):
    """One way to find and to match features.

    ``shortlist``: with how many photos, those that look most alike, a photo is matched; None for all. ``turns``:
    quarter turns in which a photo is tried; several where the kind does not see through them. ``least_inliers``,
    ``least_share``: how many matches, and what share of them, must agree on a photo's pose.
    """

    name: str
    shortlist: int | None
    turns: tuple[int, ...]
    least_inliers: int
    least_share: float

    def extract(self, photos: Sequence[Photo], quarter_turns: int = 0) -> Iterator[Features]:
        """Features of each photo, in order, as they come."""
        ...

    def match(self, pairs: Sequence[tuple[Features, Features]]) -> Iterator[Pairs]:
        """For each pair the indices (M, 2) of what is the same, in order, as they come."""
        ...


def in_pool(function: Callable[[A], B], items: Iterable[A], workers: int) -> Iterator[B]:
    """``function`` of each item, in order; when the caller stops listening, what has not begun is dropped."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)

"""Reading a spectral cloud: spectra by point, and queries that touch few of its chunks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from specimap_core.arrays import Array
from specimap_core.cloud.arrays import CloudArrays
from specimap_core.cloud.outline import in_outline
from specimap_core.cloud.schema import CHUNK_POINTS, TILE, tile_keys
from specimap_core.cloud.shards import PointArray
from specimap_core.errors import NotFoundError

Indices = NDArray[np.intp]
_NEAREST_BATCH = 16
_CHUNKS_TOGETHER = 32
_BYTES_TOGETHER = 2**24


class Cloud(CloudArrays):
    """An open cloud: ``Cloud.open(path)``. Arrays are kept once read, spectra are not.

    Safe to share between threads.
    """

    # ---- spectra --------------------------------------------------------------------------------------

    def decode(self, stored: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Stored values as reflectance, or as the counts the cube held; NaN where there is none."""
        if self.add_offset != 0:  # a difference of large numbers: float32 would lose digits
            values = (stored * self.scale_factor + self.add_offset).astype(np.float32)
        else:
            values = stored.astype(np.float32)
            if self.scale_factor != 1:
                values *= np.float32(self.scale_factor)
        if self.fill_value is not None:
            values[stored == self.fill_value] = np.nan
        return values

    def spectra(
        self, indices: ArrayLike | slice, bands: Sequence[int] | NDArray[np.integer] | None = None
    ) -> NDArray[np.float32]:
        """Decoded spectra (n, B) or (n, len(bands)) of points, in the order asked for.

        Raises NotFoundError for a point or band outside, CloudDamagedError.
        """
        return self.decode(self.stored_spectra(indices, bands))

    def stored_spectra(
        self, indices: ArrayLike | slice, bands: Sequence[int] | NDArray[np.integer] | None = None
    ) -> NDArray[np.uint16]:
        """As :meth:`spectra`, but the 16-bit values as they are stored."""
        chosen = None if bands is None else self._inside(bands, self.bands, "band")
        if isinstance(indices, slice):
            start, stop, step = indices.indices(self.n_points)
            if step == 1:
                block = self._spectra.read(start, max(start, stop))
                return block if chosen is None else block[:, chosen]
            points = np.arange(start, stop, step)
        else:
            points = self._inside(indices, self.n_points, "point")
        out = np.empty((len(points), self.bands if chosen is None else len(chosen)), np.uint16)
        for first, block, which in self._blocks_with(self._spectra, points):
            rows = block[points[which] - first]
            out[which] = rows if chosen is None else rows[:, chosen]
        return out

    def band(self, band: int) -> NDArray[np.float32]:
        """Decoded values (S,) of one band. Raises NotFoundError, CloudDamagedError."""
        return self.band_values([band])[:, 0]

    def band_values(self, bands: Sequence[int]) -> NDArray[np.float32]:
        """Decoded values (S, n) of some bands, NaN where there is none, in one pass over the cloud.

        Raises NotFoundError, CloudDamagedError.
        """
        chosen = self._inside(bands, self.bands, "band")
        out = np.empty((self.n_points, len(chosen)), np.uint16)
        for first, block in self._spectra.blocks(4096):
            out[first : first + len(block)] = block[:, chosen]
        return self.decode(out)

    def iter_chunks(self, points: int = 8192) -> Iterator[tuple[slice, NDArray[np.uint16]]]:
        """Slices of at most ``points`` consecutive points (256 at least) with their stored spectra (n, B)."""
        for first, block in self._spectra.blocks(points):
            yield slice(first, first + len(block)), block

    # ---- queries --------------------------------------------------------------------------------------

    def at_pixel(self, row: int, col: int) -> int | None:
        """The point of a pixel of the cube; None where the pixel has none."""
        point = int(self.at_pixels(np.array([[row, col]]))[0])
        return None if point < 0 else point

    def at_pixels(self, pixels: NDArray[np.integer]) -> Indices:
        """The points (n,) of pixels (n, 2) row, column of the cube; -1 where a pixel has none."""
        inside = np.asarray(((pixels >= 0) & (pixels <= 0xFFFF)).all(1))
        keys = tile_keys(np.where(inside[:, None], pixels, 0).astype(np.uint16))
        at = np.minimum(np.searchsorted(self._keys, keys), self.n_points - 1)
        return np.where(inside & (self._keys[at] == keys), at, -1)

    def in_polygon(self, vertices: ArrayLike) -> Indices:
        """Increasing indices of the points whose pixel's centre lies in the polygon (n, 2) row, column of the cube.

        By the even-odd rule; a centre on the outline lies inside.
        """
        outline = np.asarray(vertices, np.float64)
        low, high = outline.min(0), outline.max(0)
        # Points come in strips of tiles, row by row: those of the polygon's rows lie together.
        strips = self._keys >> 20
        start, stop = np.searchsorted(strips, [np.floor(low[0]) // TILE, np.floor(high[0]) // TILE + 1])
        pixels = self.hsi_pixel[start:stop]
        near = np.flatnonzero(((pixels >= low) & (pixels <= high)).all(1))
        return np.asarray(start + near[in_outline(pixels[near], outline)])

    def in_box(self, low: ArrayLike, high: ArrayLike) -> Indices:
        """Increasing indices of the points in the box from ``low`` to ``high`` (3,) mm, borders included."""
        a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
        boxes = self.chunk_aabb
        chunks = np.flatnonzero(((boxes[:, :3] <= b) & (boxes[:, 3:] >= a)).all(1))
        points = _points_of(chunks, self.n_points)
        xyz = self._xyz_of(points)
        inside = ((xyz >= a) & (xyz <= b)).all(1)
        return np.asarray(points[inside])

    def in_radius(self, centre: ArrayLike, radius_mm: float) -> Indices:
        """Increasing indices of the points at most ``radius_mm`` from ``centre`` (3,) mm."""
        place = np.asarray(centre, np.float64)
        points = _points_of(np.flatnonzero(self._box_distance(place) <= radius_mm), self.n_points)
        distance = np.linalg.norm(self._xyz_of(points) - place, axis=1)
        return np.asarray(points[distance <= radius_mm])

    def nearest(self, xyz: ArrayLike, k: int = 1) -> tuple[Indices, NDArray[np.float64]]:
        """Indices and distances mm, (min(k, S),) each, of the points nearest to ``xyz`` (3,) mm."""
        place = np.asarray(xyz, np.float64)
        to_box = self._box_distance(place)
        chunks = np.argsort(to_box, kind="stable")
        k = max(0, min(k, self.n_points))
        best, distance = np.empty(0, np.intp), np.empty(0)
        # What is found so far is sorted after each batch: for many points, a few large batches.
        batch = max(_NEAREST_BATCH, -(-k // CHUNK_POINTS))
        for at in range(0, len(chunks), batch):
            # Boxes come by distance: once the k found are nearer than the next box, none can be nearer.
            if len(best) == k and (k == 0 or to_box[chunks[at]] > distance[-1]):
                break
            points = _points_of(np.sort(chunks[at : at + batch]), self.n_points)
            found = np.linalg.norm(self._xyz_of(points) - place, axis=1)
            best, distance = np.concatenate([best, points]), np.concatenate([distance, found])
            order = np.lexsort((best, distance))[:k]
            best, distance = best[order], distance[order]
        return best, distance

    # ---- inside ---------------------------------------------------------------------------------------

    @cached_property
    def _keys(self) -> NDArray[np.uint32]:
        return tile_keys(self.hsi_pixel)

    def _xyz_of(self, points: Indices) -> Array:
        if "xyz" in vars(self):  # read before
            return self.xyz[points]
        out = np.empty((len(points), 3), np.float32)
        for first, block, which in self._blocks_with(self.array("xyz"), points):
            out[which] = block[points[which] - first]
        return out

    def _box_distance(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        boxes = self.chunk_aabb.astype(np.float64)
        outside = np.maximum(0, np.maximum(boxes[:, :3] - place, place - boxes[:, 3:]))
        return np.asarray(np.linalg.norm(outside, axis=1))

    @staticmethod
    def _blocks_with(array: PointArray, points: Indices) -> Iterator[tuple[int, Array, Indices]]:
        """First point and values of runs of chunks that hold ``points``, and which of these they hold."""
        chunk = points // array.chunk_points
        order = np.argsort(chunk, kind="stable")
        ranked = chunk[order]
        together = max(1, min(_CHUNKS_TOGETHER, _BYTES_TOGETHER // max(1, array.chunk_points * array.point_bytes)))
        gap = (np.diff(ranked) > 1) | (np.diff(ranked // together) > 0)
        for which in np.split(order, np.flatnonzero(gap) + 1):
            if len(which):
                first = int(chunk[which[0]]) * array.chunk_points
                stop = (int(chunk[which[-1]]) + 1) * array.chunk_points
                yield first, array.read(first, min(stop, array.shape[0])), which

    @staticmethod
    def _inside(values: ArrayLike, limit: int, what: str) -> Indices:
        given = np.atleast_1d(np.asarray(values))
        chosen = given.astype(np.intp)
        if given.size and (given.dtype.kind not in "iu" or given.min() < 0 or given.max() >= limit):
            raise NotFoundError(
                f"The cloud has no such {what}: it has {limit}.",
                advice=f"Give whole numbers from 0 to {limit - 1}.",
                limit=limit,
            )
        return chosen


def _points_of(chunks: Indices, n_points: int) -> Indices:
    points = (chunks[:, None] * CHUNK_POINTS + np.arange(CHUNK_POINTS)).ravel()
    return points[points < n_points]

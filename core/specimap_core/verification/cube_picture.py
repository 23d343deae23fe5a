"""Compare the cube's picture with the photos' colours through the final camera, and its bands with each other."""

from __future__ import annotations

import cv2
import numpy as np

from specimap_core.arrays import Floats, Singles
from specimap_core.cube import Cube
from specimap_core.register.tile_offsets import TileOffsets
from specimap_core.verification.figures import BandsCheck, RegistrationCheck, SeenError

LEAST_TILES = 6
SPREAD = 3.0
"""Tiles and blocks so many times farther from the common field than usual are left out of it."""
BANDS = 6
"""Bands that stand for a third of them: reading more costs time alone."""
LEAST_BANDS = 6
BLOCK_PX = 24
SOFT_PX = 1.0
ROUNDS = 4
LEAST_CONTRAST = 0.02
"""Of a block's values over those of the whole image: below, it shows nothing."""
LEAST_CORRELATION = 0.8
LEAST_BLOCKS = 12
MOST_SHIFT_PX = 3.0


def check_registration(measured: TileOffsets) -> RegistrationCheck | None:
    """What is left of the tiles' displacements; None where too few of them show."""
    kept = np.isfinite(measured.offsets[:, 0]) & (measured.weight > 0)
    if kept.sum() < LEAST_TILES:
        return None
    mm = measured.view.mm_per_px(measured.depth_mm) / measured.scale
    at, off = measured.centres[kept], measured.offsets[kept] * mm
    field = _Field.of(at, off)
    there = np.linalg.norm(field.at(at), axis=1)
    # Neighbouring tiles err together, so that many of them do not average this out.
    middle = _without(float(np.sqrt((there**2).mean())), field.sigma)
    most = max(float(np.percentile(there, 95)), middle)
    return RegistrationCheck(
        tiles=int(kept.sum()), seen_mm=SeenError(median=middle, p95=most), tile_sigma_mm=field.sigma
    )


def check_bands(cube: Cube, corners_px: Floats) -> BandsCheck | None:
    """Shift, turn and stretch of the last third of the bands against the first, between the markers' ``corners_px``
    (Q, 4, 2) x, y; None where there are too few bands or blocks that show anything."""
    good = np.flatnonzero(~cube.bad_bands)
    if len(good) < LEAST_BANDS:
        return None
    third = len(good) // 3
    ends = good[:third], good[-third:]
    first, last = (
        _soft(cube.mean_image(g[np.unique(np.linspace(0, third - 1, BANDS).round().astype(int))])) for g in ends
    )
    at, off = _block_shifts(first, last, corners_px.reshape(-1, 2))
    if len(at) < LEAST_BLOCKS:
        return None
    middle = corners_px.reshape(-1, 2).mean(0)
    field = _Field.of(at - middle, off)
    if field.count < LEAST_BLOCKS:
        return None
    rim = corners_px.reshape(-1, 2) - middle
    grown = field.at(rim) - field.unknowns[0]
    return BandsCheck(
        blocks=field.count,
        shift_px=float(np.linalg.norm(field.unknowns[0])),
        growth_px=float(np.sqrt((grown**2).sum(1).mean())),
        sigma_px=field.sigma * float(np.sqrt(2 / field.count)),
    )


class _Field:
    """An affine field of displacements, robustly fitted: ``unknowns`` (3, 2), shift and derivatives by place; ``sigma``
    of a displacement along an axis; ``count`` of those that it rests on."""

    def __init__(self, unknowns: Floats, sigma: float, count: int) -> None:
        self.unknowns, self.sigma, self.count = unknowns, sigma, count

    @staticmethod
    def of(at: Floats, off: Floats) -> _Field:
        """Fitted to displacements ``off`` (n, 2) at places (n, 2)."""
        design = np.column_stack([np.ones(len(at)), at])
        kept = np.ones(len(at), bool)
        unknowns = np.zeros((3, 2))
        for _ in range(5):
            unknowns = np.asarray(np.linalg.lstsq(design[kept], off[kept], rcond=None)[0])
            away = np.linalg.norm(off - design @ unknowns, axis=1)
            now = away <= SPREAD * max(float(np.median(away[kept])), 1e-6)
            if now.sum() < LEAST_TILES or (now == kept).all():
                break
            kept = now
        rest = (off - design @ unknowns)[kept]
        return _Field(unknowns, float(np.sqrt((rest**2).sum() / max(2 * len(rest) - 6, 1))), len(rest))

    def at(self, places: Floats) -> Floats:
        """Displacements (n, 2) at places (n, 2)."""
        return np.asarray(np.column_stack([np.ones(len(places)), places]) @ self.unknowns)


def _soft(image: Singles) -> Singles:
    known = np.isfinite(image)
    filled = np.where(known, image, np.median(image[known]) if known.any() else 0).astype(np.float32)
    # Dead pixels stand still in all bands.
    return np.asarray(cv2.GaussianBlur(cv2.medianBlur(filled, 3), (0, 0), SOFT_PX), np.float32)


def _block_shifts(first: Singles, last: Singles, around: Floats) -> tuple[Floats, Floats]:
    """Middles (n, 2) of blocks between the places ``around`` (m, 2), x, y, and by how much each lies elsewhere in
    ``last``, (n, 2) px (Lucas and Kanade; a gain of any sign, as tissue is dark in some bands and bright in others)."""
    size = np.array(first.shape[::-1])
    low = np.clip(around.min(0) - BLOCK_PX, BLOCK_PX, size - 2 * BLOCK_PX).astype(int)
    high = np.clip(around.max(0) + BLOCK_PX, BLOCK_PX, size - 2 * BLOCK_PX).astype(int)
    whole = float(first.std())
    rows, cols = (np.asarray(np.gradient(first, axis=k)) for k in (0, 1))
    at, off = [], []
    for top in range(low[1], high[1], BLOCK_PX):
        for left in range(low[0], high[0], BLOCK_PX):
            block = np.s_[top : top + BLOCK_PX, left : left + BLOCK_PX]
            there = first[block]
            if there.std() < LEAST_CONTRAST * whole:
                continue
            parts = there.ravel(), np.ones(there.size), cols[block].ravel(), rows[block].ravel()
            found = _shift_of_block(np.stack(parts, -1).astype(float), last, left, top)
            if found is not None:
                at.append((left + (BLOCK_PX - 1) / 2, top + (BLOCK_PX - 1) / 2))
                off.append(found)
    return np.array(at).reshape(-1, 2), np.array(off).reshape(-1, 2)


def _shift_of_block(design: Floats, last: Singles, left: int, top: int) -> Floats | None:
    shift = np.zeros(2)
    solve = np.linalg.solve(design.T @ design + 1e-9 * np.eye(4), design.T)
    for _ in range(ROUNDS):
        middle = left + (BLOCK_PX - 1) / 2 + shift[0], top + (BLOCK_PX - 1) / 2 + shift[1]
        seen = cv2.getRectSubPix(last, (BLOCK_PX, BLOCK_PX), middle).ravel().astype(float)
        gain, _, by_x, by_y = solve @ seen
        if not gain:
            return None
        shift = shift - np.clip(np.array([by_x, by_y]) / gain, -1, 1)
        if np.abs(shift).max() > MOST_SHIFT_PX:
            return None
    alike = abs(np.corrcoef(design[:, 0], seen)[0, 1]) > LEAST_CORRELATION if seen.std() > 0 else False
    return shift if alike else None


def _without(value: float, noise: float) -> float:
    return float(np.sqrt(max(value**2 - noise**2, 0.0)))

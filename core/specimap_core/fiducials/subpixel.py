"""Corners of dark squares on white, as intersections of lines fitted to their edges in linear light.

All edges of a photo are fitted at once: an edge takes a few hundred numbers, and one at a time they would cost more in
calls than in arithmetic.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Flags, Floats, Singles
from specimap_core.geometry.image_sampling import sample
from specimap_core.geometry.robust import SIGMA_OF_MAD

PROFILES_PER_EDGE = 24
EDGE_MARGIN = 0.12
"""Share of an edge left out at either end, where the neighbouring edge blurs into the profile."""
SAMPLE_PX = 0.25
"""Distance of samples on a profile."""
REACH_SHARES = 0.11, 0.08
"""How far profiles reach, in widths of the square, in each pass: the second starts close and sees less around."""
BATCH = 16
"""Edges whose profiles are sampled together: of like reach, and few enough to stay in the processor's cache."""
EDGE_PX = 0.8
"""Sharper edges are blurred to this, one standard deviation: between pixels, interpolation puts an edge that is sharper
up to 0.09 px off, by where it lies between them, and all profiles alike where it runs along them."""
SOFTER_PX = 0.2
"""Blurs are multiples of this, so that the edges of a photo share a few blurred pictures."""
MOST_BLUR = 1 / 40
"""Largest blur over the length of the edge: more would bring the marker's pattern into what is measured at its rim."""
BLUR_SAMPLES = 41
SIGMAS_BETWEEN_QUARTERS = 1.349
"""From a quarter to three quarters of a normal distribution."""
LEAST_RISE = 0.02
"""Linear light by which an edge must rise for its blur to be measured."""
UNMEASURED_PX = 0.5
"""Standard deviation of an edge, and of a corner, that gave no line."""


def refine_corners(linear: Singles, squares: Floats) -> tuple[Floats, Floats]:
    """Corners (N, 4, 2) of N squares seen in linear light (H, W), and one standard deviation (N,) of a corner, pixels.

    ``squares`` (N, 4, 2): the corners found so far. An edge that gives no clear profile (covered, out of the image)
    keeps the line through the corners it came with and a sigma of half a pixel.
    """
    corners, sigma = squares.copy(), np.full(len(squares), UNMEASURED_PX)
    widths = np.full((len(squares), 4), np.inf)
    rows = np.arange(len(squares))
    for share in REACH_SHARES:
        if not len(rows):
            break
        before = corners[rows]
        after = np.roll(before, -1, axis=1)
        centres = np.repeat(before.mean(1, keepdims=True), 4, axis=1)
        a, b, c = (np.asarray(x.reshape(-1, 2)) for x in (before, after, centres))
        lines, errors, seen = _fit_edges(linear, a, b, c, share, widths[rows].ravel())
        lines, errors, widths[rows] = lines.reshape(-1, 4, 3), errors.reshape(-1, 4), seen.reshape(-1, 4)
        crossed = np.cross(np.roll(lines, 1, axis=1), lines)
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = crossed[..., :2] / crossed[..., 2:]
        # A corner that runs away betrays an edge fitted to something else.
        limit = np.maximum(2.0, 0.15 * np.linalg.norm(before[:, 0] - before[:, 2], axis=1))
        stays = np.linalg.norm(moved - before, axis=2).max(1) <= limit  # false for what is not finite
        sigma[rows] = np.where(stays, np.sqrt(2 * np.mean(errors**2, axis=1)), UNMEASURED_PX)
        rows = rows[stays]
        corners[rows] = moved[stays]
    return corners, sigma


def _fit_edges(
    linear: Singles, a: Floats, b: Floats, centres: Floats, share: float, widths: Floats
) -> tuple[Floats, Floats, Floats]:
    """Lines (E, 3) with ``line @ (x, y, 1) = 0`` along the edges from ``a`` to ``b`` (both (E, 2)), their standard
    deviations (E,), and the edges' own widths (E,), infinite where no profile is clear; all in pixels. ``centres``
    (E, 2): of the squares they belong to; ``widths`` (E,): how wide the edges have proved so far."""
    length = np.linalg.norm(b - a, axis=1)
    along, normal, depth = outward_normals(a, b, centres)
    lines = _lines(normal, a)
    errors = np.full(len(a), UNMEASURED_PX)
    # The dark border is one module wide (a sixth of the edge, or less in larger dictionaries), seen at a slant.
    reach = np.clip(share * 2 * depth, 1.6, 8.0)
    s = np.linspace(EDGE_MARGIN, 1 - EDGE_MARGIN, PROFILES_PER_EDGE) * length[:, None]
    v, clear, width = np.empty(s.shape), np.empty(s.shape, bool), np.empty(s.shape)
    lacking = np.minimum(np.sqrt(np.maximum(EDGE_PX**2 - widths**2, 0)), MOST_BLUR * length)
    blur = SOFTER_PX * np.round(lacking / SOFTER_PX)
    for sd in np.unique(blur):
        light = cv2.GaussianBlur(linear, (0, 0), float(sd)) if sd else linear
        alike = np.flatnonzero(blur == sd)
        for some in np.array_split(alike[np.argsort(reach[alike])], -(-len(alike) // BATCH)):
            v[some], clear[some], width[some] = edge_positions(light, *(x[some] for x in (a, along, normal, s, reach)))
    wide = _median(width, clear)
    fits = np.flatnonzero(clear.sum(1) >= PROFILES_PER_EDGE // 2)
    if not len(fits):
        return lines, errors, wide
    slope, offset, scatter, kept = _fit_robustly(s[fits], v[fits], clear[fits])
    across = normal[fits] - along[fits] * slope[:, None]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    found = _lines(across, a[fits] + normal[fits] * offset[:, None])
    # Neighbouring profiles share pixels: about one independent measurement a pixel of edge; twice as wide at
    # the ends as in the middle, where a corner lies.
    error = np.maximum(0.01, 2 * scatter / np.sqrt(np.minimum(length[fits], kept)))
    good = kept >= PROFILES_PER_EDGE // 3
    lines[fits[good]], errors[fits[good]] = found[good], error[good]
    return lines, errors, wide


def outward_normals(a: Floats, b: Floats, dark: Floats) -> tuple[Floats, Floats, Floats]:
    """Directions (E, 2) along edges from ``a`` to ``b`` (both (E, 2)) and across them, from what is ``dark`` (E, 2)
    into what is bright, and how far (E,) the edges are from the former."""
    along = (b - a) / np.linalg.norm(b - a, axis=1)[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], -1)
    depth = _dot(normal, dark - a)
    normal *= np.where(depth > 0, -1.0, 1.0)[:, None]
    return along, normal, np.abs(depth)


def edge_positions(
    linear: Singles, a: Floats, along: Floats, normal: Floats, s: Floats, reach: Floats
) -> tuple[Floats, Flags, Floats]:
    """Where the edge crosses the profiles at ``s`` (E, K) along it, in pixels outward (E, K); which are clear; how wide
    the edge is there (E, K), one standard deviation."""
    # Profiles reach as far as their own edge asks; what pads them to the longest has no say.
    count = np.ceil((2 * reach + 1e-6) / SAMPLE_PX).astype(int)
    steps = np.arange(count.max())
    valid = (steps < count[:, None])[:, None]
    d = SAMPLE_PX * steps - reach[:, None]
    feet = a[:, None] + s[..., None] * along[:, None]
    height, width = linear.shape
    inside = np.ones(s.shape, bool)
    for end in (-reach, SAMPLE_PX * (count - 1) - reach):
        tip = feet + (end[:, None] * normal)[:, None]
        inside &= ((tip >= 1) & (tip <= [width - 2, height - 2])).all(-1)
    x, y = ((feet[..., i, None] + (d * normal[:, i, None])[:, None]).astype(np.float32) for i in (0, 1))
    rows = len(a), -1
    sampled = sample(linear, x.reshape(rows), y.reshape(rows), cv2.INTER_CUBIC).reshape(x.shape)
    profile = np.where(valid, sampled, sampled[..., :1]).astype(float)
    slope = np.gradient(profile, SAMPLE_PX, axis=2)
    last = np.broadcast_to((count - 1)[:, None, None], (*s.shape, 1))
    ends = np.take_along_axis(profile, last, 2) - np.take_along_axis(profile, last - 1, 2)
    np.put_along_axis(slope, last, ends / SAMPLE_PX, 2)
    weight = np.where(valid, np.clip(slope, 0, None), 0.0)
    contrast = profile.max(2) - profile.min(2)
    clear = inside & (contrast > 0.25 * _median(contrast, inside)[:, None]) & (weight.sum(2) > 0)
    clear[inside.sum(1) < s.shape[1] // 2] = False
    # Centroid of the slope in a window that is then centred on it: symmetric blur does not move it.
    position = np.take_along_axis(d, weight.argmax(2), 1)
    half = np.maximum(1.2, 0.7 * reach)[:, None, None]
    for _ in range(3):
        windowed = weight * np.clip(1 - np.abs(d[:, None] - position[..., None]) / half, 0, None)
        total, moment = windowed.sum(2), (windowed @ d[..., None])[..., 0]
        position = np.where(total > 0, moment / np.maximum(total, 1e-12), position)
    variance = (windowed * (d[:, None] - position[..., None]) ** 2).sum(2) / np.maximum(total, 1e-12)
    return position, clear, np.sqrt(variance)


def edge_blurs(linear: Singles, squares: Floats) -> Floats:
    """How blurred (4 N,) the edges of N squares are in linear light (H, W), one standard deviation in pixels; NaN where
    an edge is not clear. ``squares`` (N, 4, 2): their corners."""
    a, b = squares.reshape(-1, 2), np.roll(squares, -1, axis=1).reshape(-1, 2)
    along, normal, depth = outward_normals(a, b, np.repeat(squares.mean(1), 4, axis=0))
    s = np.linspace(EDGE_MARGIN, 1 - EDGE_MARGIN, PROFILES_PER_EDGE) * np.linalg.norm(b - a, axis=1)[:, None]
    d = np.clip(2 * REACH_SHARES[0] * depth, 1.6, 5.0)[:, None] * np.linspace(-1, 1, BLUR_SAMPLES)
    places = (a[:, None] + s[..., None] * along[:, None])[:, :, None] + (d[..., None] * normal[:, None])[:, None]
    rows = len(a), -1
    x, y = (places[..., i].astype(np.float32).reshape(rows) for i in (0, 1))
    rise = np.median(sample(linear, x, y, cv2.INTER_CUBIC).reshape(places.shape[:-1]), axis=1).astype(float)
    few = BLUR_SAMPLES // 8
    low, high = rise[:, :few].mean(1, keepdims=True), rise[:, -few:].mean(1, keepdims=True)
    clear = high - low > LEAST_RISE
    share = np.maximum.accumulate((rise - low) / np.where(clear, high - low, 1), axis=1)
    quarters = np.stack([(share < quarter).sum(1) for quarter in (0.25, 0.75)], 1).clip(1, BLUR_SAMPLES - 1)
    before, after = (np.take_along_axis(share, quarters - k, 1) for k in (1, 0))
    part = (np.array([0.25, 0.75]) - before) / np.maximum(after - before, 1e-9)
    places_of = quarters - 1 + np.clip(part, 0, 1)
    step = 2 * d[:, -1] / (BLUR_SAMPLES - 1)
    blurs = (places_of[:, 1] - places_of[:, 0]) * step / SIGMAS_BETWEEN_QUARTERS
    return np.asarray(np.where(clear.ravel(), blurs, np.nan))


def _fit_robustly(u: Floats, v: Floats, clear: Flags) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """Lines ``v = slope u + offset`` through the clear ones of points (E, K): slope, offset, scatter of what was kept,
    and how many were, at the fewest (E,)."""
    keep, fewest = clear, clear.sum(1)
    for _ in range(4):
        n = keep.sum(1)
        mean_u, mean_v = ((x * keep).sum(1) / n for x in (u, v))
        off_u = (u - mean_u[:, None]) * keep
        slope = (off_u * v).sum(1) / np.maximum((off_u**2).sum(1), 1e-12)
        offset = mean_v - slope * mean_u
        residual = v - (slope[:, None] * u + offset[:, None])
        limit = np.maximum(0.08, 2.5 * SIGMA_OF_MAD * _median(np.abs(residual), keep))
        keep = clear & (np.abs(residual) <= limit[:, None])
        fewest = np.minimum(fewest, keep.sum(1))
    n = keep.sum(1)
    mean = (residual * keep).sum(1) / n
    scatter = np.sqrt((((residual - mean[:, None]) * keep) ** 2).sum(1) / n)
    return slope, offset, scatter, np.where(fewest < PROFILES_PER_EDGE // 3, fewest, n)


def _median(values: Floats, keep: Flags) -> Floats:
    """Median (E,) of those of ``values`` (E, K) that ``keep`` names; infinite where there are none."""
    ordered, n = np.sort(np.where(keep, values, np.inf), axis=1), keep.sum(1)
    middle = np.stack([(n - 1) // 2, n // 2], 1)
    return np.asarray(np.take_along_axis(ordered, middle, 1).mean(1))


def _lines(normal: Floats, through: Floats) -> Floats:
    return np.concatenate([normal, -_dot(normal, through)[:, None]], 1)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray((a * b).sum(1))

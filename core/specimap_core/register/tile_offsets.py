"""Measure how far tiles of the specimen show in the cube from where a solved camera expects them.

The photos' colours on the mesh are seen through that camera and compared with the cube's own image. A tile is moved
over the image; at each place the image is explained by a linear mixture of the tile's channels (logarithms of its
colours, normals), so that neither the sign nor the strength of a colour's contrast has to be known, nor the light. The
tiles vote for one shift, near which each of them then has a best place of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View
from specimap_core.register.destriping import destriped
from specimap_core.register.tile_matching import Tiles
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import on_card, on_specimen, raised_mm

PIXEL_MM = 0.2
"""Working pixel on the marker plane: finer detail differs between a photo's and a cube's lens."""
LONGEST_PX = 480
FINE_MM, BROAD_MM = 0.25, 1.6
"""Sd of the two Gaussians between which detail counts: noise is finer, light and shade are broader."""
TILE_MM = 8.0
REACH_MM = 6.0
"""Longest shift looked for; markers lie within about a centimetre of a specimen."""
TURN_REACH_MM = 1.6
"""How far a tile's own best place may lie from the common one: a turn of 6 degrees on a specimen of 30 mm."""
MARGIN_MM = 1.2
"""Width of the tray around the specimen that belongs to it, so that its outline counts."""
DARKEST = 0.02
"""Added before a logarithm is taken: below it lies noise."""
LEAST_CLEAR = 1.25
"""The common place must explain this much more than any other: below, several places are as good."""
SAMPLES = 24
"""Places of the surface that stand for a tile."""


@dataclass(frozen=True)
class TileOffsets:
    """Offsets of tiles in an image, measured through ``view``.

    ``centres`` (T, 2) and ``offsets`` (T, 2) x, y in working pixels of ``px`` mm on the marker plane: each tile's place
    about their common middle, and how far from there it shows (NaN where it does not); ``weight`` (T,), zero where it
    says nothing; ``points`` (T, S, 3) mm of the surface in each tile; ``scale`` (2,): working pixels in one of the
    image's; ``depth_mm``: of the specimen before the camera.
    """

    view: View
    centres: Floats
    offsets: Floats
    weight: Floats
    points: Floats
    px: float
    scale: Floats
    depth_mm: float


def measure_tile_offsets(
    image: NDArray[np.float32],
    view: View,
    caster: RayCaster,
    corners: Floats,
    *,
    mirrored: bool = False,
    reach_mm: float = REACH_MM,
) -> TileOffsets | None:
    """Measure the tiles' offsets; None where there is none, it has no texture, or the tiles' places contradict.

    ``image`` (rows, cols): a linear image of the cube in its own columns, such as its band mean, NaN where unknown;
    ``view``: the cube's solved camera; ``corners`` (Q, 4, 3) mm of the markers; ``mirrored``: the cube's columns run
    the wrong way round; ``reach_mm``: longest shift looked for.
    """
    seen = image[:, ::-1] if mirrored else image
    spans = view.mm_per_px(float(view.cam_from_world.apply(corners.reshape(-1, 3))[:, 2].mean()))
    span = float(np.sqrt(spans.prod()))
    px = max(span, PIXEL_MM, span * max(seen.shape) / LONGEST_PX)
    scale = spans / px
    working = view.scaled(float(scale[0]), float(scale[1]))
    box = _box(working, caster, corners, px)
    if box is None:
        return None
    channels, specimen, xyz, depth = _rendered(working, box, caster, corners, px)
    if not specimen.any():
        return None
    grey = _log_image(seen, float(scale[0]), float(scale[1]))
    known = channels[-1] > 0
    detail = np.stack([_detail(c, known, px) for c in channels[:-1]])
    tiles = Tiles.of(specimen, TILE_MM / px, reach_mm / px)
    if tiles is None:
        return None
    scores = tiles.scores(detail, _detail(grey, np.ones(grey.shape, bool), px), box)
    found = _vote(scores, px)
    if found is None:
        return None
    offsets, weight = found
    points = np.stack([_sampled(xyz, tiles, t) for t in range(len(tiles.centres))])
    return TileOffsets(view, tiles.centres, offsets, weight, points, px, scale, depth)


def _sampled(xyz: NDArray[np.float32], tiles: Tiles, tile: int) -> Floats:
    """Places (S, 3) of the surface spread over a tile."""
    r, c = tiles.corner[tile]
    y, x = np.nonzero(tiles.mask[tile])
    chosen = np.linspace(0, len(y) - 1, SAMPLES).round().astype(int)
    return np.asarray(xyz[r + y[chosen], c + x[chosen]], float)


def _box(view: View, caster: RayCaster, corners: Floats, px: float) -> tuple[int, int, int, int] | None:
    """Rows from, to and columns from, to of the part of the image that can show the specimen, with its surroundings."""
    vertices = caster.mesh.vertices[caster.mesh.vertices[:, 2] > raised_mm(corners)]
    if not len(vertices):
        return None
    at = view.project(vertices.astype(float))
    rim = (MARGIN_MM + BROAD_MM) / px
    width, height = view.intrinsics.width, view.intrinsics.height
    left, top = np.clip(np.floor(at.min(0) - rim), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(at.max(0) + rim) + 1, 0, [width, height]).astype(int)
    return (int(top), int(bottom), int(left), int(right)) if top < bottom and left < right else None


def _rendered(
    view: View, box: tuple[int, int, int, int], caster: RayCaster, corners: Floats, px: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32], float]:
    """Channels (C + 1, h, w) of the mesh as the camera sees it within ``box``, the last being 1 where it meets it; the
    specimen with a margin (h, w); the places (h, w, 3) seen; the specimen's median depth, mm."""
    top, bottom, left, right = box
    shape = bottom - top, right - left
    rows, cols = np.indices(shape).reshape(2, -1)
    pixels = np.stack([cols + left, rows + top], -1).astype(float)
    hits = caster.cast(view.origins(pixels), view.world_rays(pixels))
    at = np.flatnonzero(hits.hit)
    channels = np.zeros((7, len(rows)), np.float32)
    linear = (caster.colours(hits)[at].astype(np.float32) / 255) ** np.float32(2.2)
    channels[:3, at] = np.log(linear + np.float32(DARKEST)).T
    channels[3:6, at] = caster.normals(hits)[at].T
    channels[6, at] = 1
    xyz = hits.xyz[at]
    card = on_card(xyz, corners)
    on_it = on_specimen(np.stack([rows[at], cols[at]], -1).astype(np.uint16), xyz, card, corners)
    depth = float(np.median(view.cam_from_world.apply(xyz[on_it].astype(float))[:, 2])) if on_it.any() else 1.0
    specimen = np.zeros(len(rows), np.uint8)
    specimen[at[on_it]] = 1
    size = 2 * round(MARGIN_MM / px) + 1
    wide = cv2.dilate(specimen.reshape(shape), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    wide = wide.ravel().astype(bool) & hits.hit
    wide[at[card]] = False
    return channels.reshape(7, *shape), wide.reshape(shape), hits.xyz.reshape(*shape, 3), depth


def _log_image(seen: NDArray[np.float32], across: float, down: float) -> NDArray[np.float32]:
    """Logarithm of the image at ``across`` of its width and ``down`` of its height, without dead pixels and lines."""
    seen = destriped(seen)
    finite = np.isfinite(seen)
    middle = np.float32(np.median(seen[finite])) if finite.any() else np.float32(0)
    calm = cv2.medianBlur(np.ascontiguousarray(np.where(finite, seen, middle), np.float32), 3)
    # By the factors themselves: brought to a rounded size, the middle of an image moves by a tenth of a pixel. One
    # after the other where they differ: with one of them above 1, both would sample instead of average.
    if across == down:
        calm = cv2.resize(calm, None, fx=across, fy=down, interpolation=cv2.INTER_AREA)
    else:
        calm = cv2.resize(calm, None, fx=across, fy=1.0, interpolation=cv2.INTER_AREA)
        calm = cv2.resize(calm, None, fx=1.0, fy=down, interpolation=cv2.INTER_AREA)
    low, high = np.percentile(calm, [0.5, 99.5])
    share = np.clip((calm - low) / max(float(high - low), 1e-9), 0, 1)
    return np.asarray(np.log(share + DARKEST), np.float32)


def _detail(image: NDArray[np.float32], known: NDArray[np.bool_], px: float) -> NDArray[np.float32]:
    """What lies between the two Gaussians; unknown pixels are left out of both."""
    weight = known.astype(np.float32)

    def blurred(sd_mm: float) -> NDArray[np.float32]:
        sd = max(sd_mm / px, 0.6)
        return np.asarray(
            cv2.GaussianBlur(image * weight, (0, 0), sd) / np.maximum(cv2.GaussianBlur(weight, (0, 0), sd), 1e-3)
        )

    return np.asarray((blurred(FINE_MM) - blurred(BROAD_MM)) * weight, np.float32)


def _vote(scores: NDArray[np.float32], px: float) -> tuple[Floats, Floats] | None:
    """Each tile's best shift (T, 2) x, y px near the common one, and its weight (T,); None without a clear one."""
    n = scores.shape[1]
    # Where a specimen turned, its tiles' best places lie somewhat apart: widened, they still meet.
    wide = round(0.5 * TURN_REACH_MM / px)
    together = cv2.GaussianBlur(scores.mean(0), (0, 0), max(wide / 2, 1.0)) - float(np.median(scores))
    y, x = divmod(int(together.argmax()), n)
    rows, cols = np.indices(together.shape)
    apart = np.hypot(rows - y, cols - x) > 2 * TURN_REACH_MM / px
    if not apart.any() or together[y, x] < LEAST_CLEAR * max(float(together[apart].max()), 1e-6):
        return None
    near = int(np.ceil(TURN_REACH_MM / px))
    top, left = max(y - near, 0), max(x - near, 0)
    window = scores[:, top : y + near + 1, left : x + near + 1]
    offsets, weight = np.full((len(scores), 2), np.nan), np.zeros(len(scores))
    for t, part in enumerate(window):
        r, c = divmod(int(part.argmax()), part.shape[1])
        if 0 < r < part.shape[0] - 1 and 0 < c < part.shape[1] - 1:
            offsets[t] = (
                left + c + _peak(part[r, c - 1 : c + 2]) - n // 2,
                top + r + _peak(part[r - 1 : r + 2, c]) - n // 2,
            )
            weight[t] = float(part[r, c])
    return offsets, weight


def _peak(three: NDArray[np.float32]) -> float:
    """Place of the parabola's top through values at -1, 0, 1."""
    a, b, c = (float(v) for v in three)
    bend = a - 2 * b + c
    return float(np.clip((a - c) / (2 * bend), -0.5, 0.5)) if bend < 0 else 0.0

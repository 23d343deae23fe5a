"""Whether the specimen lies in the cube where the photos saw it, judged by its texture and outline.

The photos' colours on the mesh are seen through the solved camera of the cube, whose pose rests on the markers alone,
and compared with the cube's own image, tile by tile. A tile is moved over the image; at each place the image is
explained by a linear mixture of the tile's channels (logarithms of its colours, normals), so that neither the sign
nor the strength of a colour's contrast has to be known, nor the light. The tiles vote for one shift; where
each of them then fits best gives a rigid motion in the image's plane, and their scatter its uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap.core.geometry import Floats, View
from specimap.core.points import on_card, on_specimen, raised_mm
from specimap.core.raycast import RayCaster
from specimap.core.register.tiles import LEAST_TILES, Tiles
from specimap.core.robust import SIGMA_OF_MAD

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
LEAST_AGREE = 0.6
LEAST_MARKERS = 4
"""Three nearly coplanar markers leave the cube's focal length open: raised tissue then seems to have moved."""
SHARED_MM = 0.02
"""What all tiles are off together, one sd: seen through the true camera, specimens that did not move show 0.00 to 0.01
mm on own phantoms and 0.02 to 0.03 mm on path-traced ones."""
ALLOWED_MM = 0.3
ALLOWED_SIGMA = 4.0


@dataclass(frozen=True)
class Shift:
    """Motion of the specimen between photos and cube.

    ``shift_mm`` (2,): of its middle in x and y of the marker frame; ``turn_deg`` about the cube camera's axis,
    counter-clockwise seen from above; ``moved_mm``: root mean square over the specimen of the distance by which its
    parts are off; ``sigma_mm``: one standard deviation of that; ``tiles``: how many parts it rests on.
    """

    shift_mm: tuple[float, float]
    turn_deg: float
    moved_mm: float
    sigma_mm: float
    tiles: int

    @property
    def significant(self) -> bool:
        """Whether it is more than registration allows."""
        return self.moved_mm > max(ALLOWED_MM, ALLOWED_SIGMA * self.sigma_mm)

    @property
    def message(self) -> str:
        """In a sentence."""
        return f"The specimen seems to have moved by about {self.moved_mm:.1f} mm between photos and cube."


def specimen_shift(
    image: NDArray[np.float32],
    view: View,
    caster: RayCaster,
    corners: Floats,
    *,
    markers_in_cube: int,
    mirrored: bool = False,
) -> Shift | None:
    """Motion of the specimen, or None where it cannot be told: no specimen, no texture, places that contradict, or too
    few markers in the cube to tell a motion from a wrong camera.

    ``image`` (rows, cols): a linear image of the cube in its own columns, such as its band mean, NaN where unknown;
    ``view``: the cube's solved camera; ``corners`` (Q, 4, 3) mm of the markers; ``mirrored``: the cube's columns run
    the wrong way round.
    """
    if markers_in_cube < LEAST_MARKERS:
        return None
    seen = image[:, ::-1] if mirrored else image
    lens, pose = view.intrinsics, view.cam_from_world
    mm_per_px = float(pose.apply(corners.reshape(-1, 3))[:, 2].mean()) / lens.focal_px
    factor = min(1.0, mm_per_px / PIXEL_MM, LONGEST_PX / max(seen.shape))
    lens = lens.scaled(factor)
    px = mm_per_px / factor
    box = _box(View(lens, pose), caster, corners, px)
    if box is None:
        return None
    channels, specimen, depth = _rendered(View(lens, pose), box, caster, corners, px)
    if not specimen.any():
        return None
    grey = _log_image(seen, factor)
    known = channels[-1] > 0
    detail = np.stack([_detail(c, known, px) for c in channels[:-1]])
    tiles = Tiles.of(specimen, TILE_MM / px, REACH_MM / px)
    if tiles is None:
        return None
    scores = tiles.scores(detail, _detail(grey, np.ones(grey.shape, bool), px), box)
    found = _vote(scores, px)
    if found is None:
        return None
    offsets, weight = found
    motion = _rigid(tiles.centres, offsets, weight, px)
    if motion is None:
        return None
    (dx, dy), turn, moved, sigma, count = motion
    mm = depth / float(lens.focal_px)
    # Image to marker frame: the camera looks down, so that its axes' horizontal parts carry the shift.
    across = pose.R.T @ np.array([dx * mm, dy * mm, 0.0])
    shift = float(across[0]), float(across[1])
    return Shift(shift, -float(np.degrees(turn)), float(moved * mm), float(sigma * mm), count)


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
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """Channels (C + 1, h, w) of the mesh as the camera sees it within ``box``, the last being 1 where it meets it; the
    specimen with a margin (h, w); its median depth, mm."""
    top, bottom, left, right = box
    shape = bottom - top, right - left
    rows, cols = np.indices(shape).reshape(2, -1)
    pixels = np.stack([cols + left, rows + top], -1).astype(float)
    hits = caster.cast(view.cam_from_world.centre, view.world_rays(pixels))
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
    return channels.reshape(7, *shape), wide.reshape(shape), depth


def _log_image(seen: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Logarithm of the image at ``factor`` of its size, without single dead pixels."""
    finite = np.isfinite(seen)
    middle = np.float32(np.median(seen[finite])) if finite.any() else np.float32(0)
    calm = cv2.medianBlur(np.ascontiguousarray(np.where(finite, seen, middle), np.float32), 3)
    # By the factor itself: brought to a rounded size, the middle of an image moves by a tenth of a pixel.
    calm = cv2.resize(calm, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
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


def _rigid(
    centres: Floats, offsets: Floats, weight: Floats, px: float
) -> tuple[tuple[float, float], float, float, float, int] | None:
    """Shift (x, y) px, turn rad, RMS displacement px, its sd px, tiles used; None where the tiles contradict."""
    keep = np.isfinite(offsets[:, 0]) & (weight > 0)
    known = int(keep.sum())
    if known < LEAST_TILES:
        return None
    for _ in range(10):
        p, d, w = centres[keep], offsets[keep], weight[keep]
        # Small turns: d = shift + turn x p.
        zero, one = np.zeros(len(p)), np.ones(len(p))
        A = np.concatenate([np.stack([one, zero, -p[:, 1]], -1), np.stack([zero, one, p[:, 0]], -1)])
        root = np.sqrt(np.tile(w, 2))
        answer = np.linalg.lstsq(A * root[:, None], np.concatenate([d[:, 0], d[:, 1]]) * root, rcond=None)[0]
        turned = np.stack([-centres[:, 1], centres[:, 0]], -1) * answer[2]
        off = np.linalg.norm(offsets - answer[:2] - turned, axis=1)
        limit = max(2.5 * SIGMA_OF_MAD * float(np.median(off[keep])) / 1.18, 0.5)
        kept = np.isfinite(off) & (weight > 0) & (off < limit)
        if kept.sum() < LEAST_TILES or (kept == keep).all():
            break
        keep = kept
    if keep.sum() < max(LEAST_TILES, LEAST_AGREE * len(centres)):
        return None
    residual = off[keep]
    # Two of three numbers are shared: what is left of 2 n values after three unknowns.
    per_axis = float(np.sqrt((residual**2).sum() / max(2 * len(residual) - 3, 1)))
    moved = float(np.sqrt((answer[:2] ** 2).sum() + answer[2] ** 2 * (centres[keep] ** 2).sum(1).mean()))
    sigma = float(np.hypot(per_axis * np.sqrt(2 / len(residual)), SHARED_MM / px))
    return (float(answer[0]), float(answer[1])), float(answer[2]), moved, sigma, int(keep.sum())

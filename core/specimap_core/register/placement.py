"""Place every cube pixel on the surface, by the solved camera or by the published homography."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from specimap_core.arrays import Floats
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import View
from specimap_core.render.orthographic import Grid
from specimap_core.surface.raycast import RayCaster

GRAZING_DEG = 70.0
STRIP_PIXELS = 1 << 16
STRIP_WORKERS = 2
CLEARANCE_MM = 0.02
"""How far from a place a ray to whatever may hide it starts: beyond rounding. More would miss what hides near by."""


@dataclass(frozen=True)
class Placement:
    """Where the cube's pixels lie on the surface.

    ``pixels`` (S, 2) row and column of those that meet the surface; ``xyz`` (S, 3) mm; ``normal`` (S, 3) unit;
    ``rgb`` (S, 3); ``incidence_deg`` (S,) between normal and the direction to the camera; ``occluded`` (S,): the
    surface stands between this place and the cube's camera; ``triangle`` (S,) and ``barycentric`` (S, 2) on the
    mesh (-1 where the place was looked up on a grid). ``undercut`` (S,): other surface stands above this place.
    """

    pixels: NDArray[np.uint16]
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    incidence_deg: NDArray[np.float32]
    occluded: NDArray[np.bool_]
    undercut: NDArray[np.bool_]
    triangle: NDArray[np.int32]
    barycentric: NDArray[np.float32]


@dataclass(frozen=True)
class Homography:
    """The published map: ``H`` (3, 3) from cube pixels to the coarse grid's; inliers (N,) of the corners."""

    H: Floats
    inliers: NDArray[np.bool_]


def fit_homography(corners: Floats, corners_px: Floats, coarse: Grid, ransac_px: float) -> Homography:
    """Homography from cube corners (N, 2) to the coarse grid, RANSAC as published.

    Raises:
        RegistrationError: no homography fits.
    """
    target = coarse.pixel_of(corners[:, :2])
    cv2.setRNGSeed(0)
    H, inliers = cv2.findHomography(corners_px, target, cv2.RANSAC, ransac_px)
    if H is None:
        raise RegistrationError(
            "No homography maps the cube's corners onto the grid.",
            advice="Check that cube and photos show the same, unmoved markers.",
        )
    return Homography(np.asarray(H, float), inliers.ravel().astype(bool))


def _map_to_fine(homography: Homography, coarse: Grid, fine: Grid, pixels: Floats) -> Floats:
    """Cube pixels (N, 2) x, y, as the camera saw them, to pixels of the fine grid (N, 2): diag(s, s, 1) H."""
    s = coarse.cell_mm / fine.cell_mm
    mapped = np.c_[pixels, np.ones(len(pixels))] @ (np.diag([s, s, 1.0]) @ homography.H).T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def homography_xyz(homography: Homography, coarse: Grid, fine: Grid, pixels: Floats) -> NDArray[np.float32]:
    """Where the published method puts cube pixels (N, 2) x, y: xyz (N, 3) mm, NaN off the surface."""
    at = _map_to_fine(homography, coarse, fine, pixels)[:, ::-1].T
    return np.stack([map_coordinates(fine.xyz[..., k], at, order=1, cval=np.nan) for k in range(3)], -1)


def place_by_homography(
    homography: Homography, coarse: Grid, fine: Grid, view: View, caster: RayCaster, mirrored: bool
) -> Placement:
    """Map pixels onto the fine grid by diag(s, s, 1) H and look up xyz bilinearly, as published."""
    layers = np.concatenate([fine.xyz, fine.normal, fine.image.astype(np.float32)], -1)

    def place(rows: NDArray[np.int64], cols: NDArray[np.int64], seen: Floats) -> Placement:
        at = _map_to_fine(homography, coarse, fine, seen)[:, ::-1].T
        found = np.stack(
            [map_coordinates(layers[..., k], at, order=1, cval=np.nan) for k in range(layers.shape[-1])], -1
        )
        keep = np.isfinite(found[:, :6]).all(-1)
        xyz, normal, rgb = found[keep, :3], found[keep, 3:6], found[keep, 6:]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        colours = np.clip(rgb + 0.5, 0, 255).astype(np.uint8)
        return _placement(np.stack([rows[keep], cols[keep]], -1), xyz, normal, colours, view, caster, None)

    return _in_strips(view, mirrored, place)


def place_by_camera(view: View, caster: RayCaster, mirrored: bool) -> Placement:
    """Cast each pixel's own ray onto the mesh: raised tissue lands where it is.

    Raises:
        RegistrationError: no ray meets the mesh.
    """

    def place(rows: NDArray[np.int64], cols: NDArray[np.int64], seen: Floats) -> Placement:
        hits = caster.cast(view.origins(seen), view.world_rays(seen))
        keep = hits.hit
        normals, rgb = caster.normals(hits)[keep], caster.colours(hits)[keep]
        return _placement(
            np.stack([rows[keep], cols[keep]], -1),
            hits.xyz[keep],
            normals,
            rgb,
            view,
            caster,
            (hits.triangle[keep], hits.barycentric[keep]),
        )

    return _in_strips(view, mirrored, place)


def _in_strips(
    view: View, mirrored: bool, place: Callable[[NDArray[np.int64], NDArray[np.int64], Floats], Placement]
) -> Placement:
    """Place the cube's pixels strip by strip, so that a large cube needs little more memory than its points."""
    lens = view.intrinsics
    at_once = max(1, STRIP_PIXELS // lens.width)

    def strip(start: int) -> Placement:
        rows, cols = np.indices((min(at_once, lens.height - start), lens.width)).reshape(2, -1)
        rows += start
        seen = np.stack([lens.width - 1 - cols if mirrored else cols, rows], -1).astype(float)
        return place(rows, cols, seen)

    with ThreadPoolExecutor(STRIP_WORKERS) as pool:
        parts = list(pool.map(strip, range(0, lens.height, at_once)))
    joined = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Placement)}
    if not len(joined["pixels"]):
        raise RegistrationError(
            "No pixel of the cube meets the surface.",
            advice="Check that cube and photos show the same specimen between the same markers.",
        )
    return Placement(**joined)


def _placement(
    pixels: NDArray[np.integer],
    xyz: NDArray[np.float32],
    normal: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    view: View,
    caster: RayCaster,
    where: tuple[NDArray[np.int32], NDArray[np.float32]] | None,
) -> Placement:
    away = view.eyes(xyz.astype(float)) - xyz
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    cosine = np.clip((away * normal).sum(1), -1, 1)
    occluded, undercut = np.zeros(len(xyz), bool), np.zeros(len(xyz), bool)
    if where is None:
        occluded = _occluded_from(view, xyz, caster)
        where = np.full(len(xyz), -1, np.int32), np.zeros((len(xyz), 2), np.float32)
    else:
        up = np.broadcast_to([0.0, 0.0, 1.0], xyz.shape)
        undercut = caster.cast(xyz.astype(float) + CLEARANCE_MM * up, up).hit
    return Placement(
        pixels.astype(np.uint16),
        xyz.astype(np.float32),
        normal.astype(np.float32),
        rgb,
        np.degrees(np.arccos(cosine)).astype(np.float32),
        occluded,
        undercut,
        *where,
    )


def _occluded_from(view: View, xyz: NDArray[np.float32], caster: RayCaster) -> NDArray[np.bool_]:
    """Whether tissue stands between the camera and places (S, 3) that were looked up from above.

    Judged at the surface's own highest point over each place: the grid's cells smear their places across steps, and
    what is hidden is often no wider than a cell.
    """
    above = xyz.astype(float)
    above[:, 2] = float(caster.mesh.vertices[:, 2].max()) + 1.0
    top = caster.cast(above, np.broadcast_to([0.0, 0.0, -1.0], above.shape))
    place = np.where(top.hit[:, None], top.xyz, xyz).astype(float)
    away = view.eyes(place) - place
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return caster.cast(place + CLEARANCE_MM * away, away).hit

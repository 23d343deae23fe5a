"""Place every cube pixel on the surface, by the solved camera or by the published homography."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap.core.errors import RegistrationError
from specimap.core.geometry import Floats, View
from specimap.core.raycast import RayCaster
from specimap.core.render import Grid

Method = Literal["camera", "homography"]
GRAZING_DEG = 70.0


@dataclass(frozen=True)
class RegisterSettings:
    """``method``: ``camera`` or ``homography``. ``ransac_px``: inlier distance on the coarse grid, as published."""

    method: Method = "camera"
    ransac_px: float = 3.0


@dataclass(frozen=True)
class Placement:
    """Where the cube's pixels lie on the surface.

    ``pixels`` (S, 2) row and column of those that meet the surface; ``xyz`` (S, 3) mm; ``normal`` (S, 3) unit;
    ``rgb`` (S, 3); ``incidence_deg`` (S,) between normal and the direction to the camera; ``occluded`` (S,): the
    surface stands between this place and the cube's camera; ``triangle`` (S,) and ``barycentric`` (S, 2) on the
    mesh (-1 where the place was looked up on a grid).
    """

    pixels: NDArray[np.uint16]
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    incidence_deg: NDArray[np.float32]
    occluded: NDArray[np.bool_]
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


def place_by_homography(homography: Homography, coarse: Grid, fine: Grid, view: View, caster: RayCaster,
                        mirrored: bool) -> Placement:  # fmt: skip
    """Map pixels onto the fine grid by diag(s, s, 1) H and look up xyz bilinearly, as published."""
    lens = view.intrinsics
    s = coarse.cell_mm / fine.cell_mm
    H = np.diag([s, s, 1.0]) @ homography.H
    rows, cols = np.indices((lens.height, lens.width))
    seen_cols = lens.width - 1 - cols if mirrored else cols
    pixels = np.stack([seen_cols, rows, np.ones_like(rows)], -1).reshape(-1, 3).astype(float)
    mapped = pixels @ H.T
    at = (mapped[:, :2] / mapped[:, 2:]).astype(np.float32).reshape(lens.height, lens.width, 2)

    def look_up(values: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(
            cv2.remap(values, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
                      borderValue=float("nan"))
        )  # fmt: skip

    xyz = look_up(fine.xyz)
    keep = np.isfinite(xyz).all(-1)
    points = xyz[keep]
    normal = look_up(fine.normal)[keep]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    rgb = np.nan_to_num(look_up(fine.image.astype(np.float32))[keep])
    return _placed(
        np.stack([rows[keep], cols[keep]], -1), points, normal, np.clip(rgb + 0.5, 0, 255).astype(np.uint8),
        view, caster, None,
    )  # fmt: skip


def place_by_camera(view: View, caster: RayCaster, mirrored: bool) -> Placement:
    """Cast each pixel's own ray onto the mesh: raised tissue lands where it is."""
    lens = view.intrinsics
    rows, cols = np.indices((lens.height, lens.width), dtype=np.int32).reshape(2, -1)
    seen_cols = lens.width - 1 - cols if mirrored else cols
    directions = view.world_rays(np.stack([seen_cols, rows], -1).astype(float))
    hits = caster.cast(view.cam_from_world.centre, directions)
    keep = hits.hit
    if not keep.any():
        raise RegistrationError(
            "No ray of the cube meets the surface.",
            advice="Check that cube and photos show the same specimen between the same markers.",
        )
    normals, rgb = caster.normals(hits)[keep], caster.colours(hits)[keep]
    return _placed(
        np.stack([rows[keep], cols[keep]], -1), hits.xyz[keep], normals, rgb, view, caster,
        (hits.triangle[keep], hits.barycentric[keep]),
    )  # fmt: skip


def _placed(
    pixels: NDArray[np.integer],
    xyz: NDArray[np.float32],
    normal: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    view: View,
    caster: RayCaster,
    where: tuple[NDArray[np.int32], NDArray[np.float32]] | None,
) -> Placement:
    away = view.cam_from_world.centre - xyz
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    cosine = np.clip((away * normal).sum(1), -1, 1)
    occluded = np.zeros(len(xyz), bool)
    if where is None:
        # A place looked up from above can lie behind tissue for the cube's camera.
        occluded = caster.cast(xyz + 0.5 * away, away).hit
        where = np.full(len(xyz), -1, np.int32), np.zeros((len(xyz), 2), np.float32)
    return Placement(
        pixels.astype(np.uint16), xyz.astype(np.float32), normal.astype(np.float32), rgb,
        np.degrees(np.arccos(cosine)).astype(np.float32), occluded, *where,
    )  # fmt: skip

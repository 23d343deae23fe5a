"""The least squares behind stages 1 and 2: cameras and markers from marker corners.

Unknowns: a shared lens (focal length, principal point, two radial terms), a pose per photo, and the markers,
either rigid squares of known edge (a pose each) or four free points each. Derivatives are analytic; the normal
equations are dense, since a marker is seen by most photos. Robustness is by reweighting (Huber 1964 on whole
markers' corners); Levenberg-Marquardt damping also takes care of the free choice of frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from specimap.core.geometry import Floats, Intrinsics, Pose, rotation_from_vector, skew
from specimap.core.robust import MEDIAN_OF_RAYLEIGH

Ints = NDArray[np.int64]

LENS = 5  # log focal length, cx, cy, k1, k2
PRIOR_FOCAL = 0.05
"""Standard deviation of the logarithm of a focal length that EXIF states."""
PRIOR_CENTRE = 0.003
"""Standard deviation of the principal point about the image's centre, as a share of the width."""
PRIOR_RADIAL = (0.1, 0.1)
HUBER = 2.5
"""Residuals beyond this many standard deviations lose weight."""
NOISE_ROUNDS = 3
"""How often the scatter of the corners is estimated anew; large at first, so that a rough start is forgiven."""


@dataclass(frozen=True)
class Observations:
    """M markers seen in photos.

    ``photo`` and ``marker`` (M,): indices; ``corners_px`` (M, 4, 2); ``sigma_px`` (M,) of a coordinate.
    """

    photo: Ints
    marker: Ints
    corners_px: Floats
    sigma_px: Floats

    def of(self, keep: NDArray[np.bool_]) -> Observations:
        """Those where ``keep`` (M,) is true."""
        return Observations(self.photo[keep], self.marker[keep], self.corners_px[keep], self.sigma_px[keep])


@dataclass(frozen=True)
class MarkerScene:
    """A state of the unknowns: one lens, P photo poses, and the corners (Q, 4, 3) of Q markers.

    ``squares``: poses ``world_from_marker`` of the markers where they are rigid, else None.
    """

    lens: Intrinsics
    poses: tuple[Pose, ...]
    corners: Floats
    squares: tuple[Pose, ...] | None

    def residuals(self, seen: Observations) -> Floats:
        """Projected minus measured corners, (M, 4, 2) pixels."""
        R = np.stack([p.R for p in self.poses])[seen.photo]
        t = np.stack([p.t for p in self.poses])[seen.photo]
        cam = np.einsum("mij,mcj->mci", R, self.corners[seen.marker]) + t[:, None]
        return self.lens.project(cam) - seen.corners_px


@dataclass(frozen=True)
class SolveInfo:
    """How a solution was reached: iterations, final robust cost, RMS in pixels before and after (unweighted
    corner distance), weights (M,) that the robust loss left, the normal matrix of all unknowns, and the factor by
    which the corners scatter beyond their stated sigma, which the normal matrix already counts."""

    iterations: int
    cost: float
    rms_before_px: float
    rms_after_px: float
    weights: Floats
    normal: Floats
    excess: float


def square_corners(edge_mm: float) -> Floats:
    """Corners (4, 3) of a marker in its own frame: x right, y up, z out of the print; origin at its centre."""
    h = edge_mm / 2
    return np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])


def rms_px(residuals: Floats) -> float:
    """Root of the mean squared corner distance of residuals (M, 4, 2)."""
    return float(np.sqrt((residuals**2).sum(-1).mean()))


def solve(
    scene: MarkerScene,
    seen: Observations,
    *,
    edge_mm: float,
    refine_lens: bool,
    robust: bool = True,
    focal_prior_px: float | None = None,
    iterations: int = 60,
) -> tuple[MarkerScene, SolveInfo]:
    """Minimise the weighted reprojection error.

    Rigid where ``scene.squares`` is given (millimetres follow from ``edge_mm``), else free corners, whose scale
    stays as it is. With ``refine_lens`` false the lens is fixed, as published.
    """
    before = rms_px(scene.residuals(seen))
    prior_focal = focal_prior_px or scene.lens.focal_px
    focal_sd = PRIOR_FOCAL if focal_prior_px else 10.0
    given, steps = seen, 0
    for _ in range(NOISE_ROUNDS if robust else 1):
        # What the corners scatter by beyond their own sigma (an uneven print, a lens that two terms do not
        # describe) is noise all the same; unless it is counted, the priors have no say.
        norm = np.sqrt((scene.residuals(given) ** 2).sum(-1)) / given.sigma_px[:, None]
        excess = max(1.0, float(np.median(norm)) / MEDIAN_OF_RAYLEIGH)
        seen = replace(given, sigma_px=given.sigma_px * excess)
        system = partial(
            _normal_equations, seen=seen, edge_mm=edge_mm, refine_lens=refine_lens, robust=robust,
            prior_focal=prior_focal, focal_sd=focal_sd,
        )  # fmt: skip
        scene, taken, (H, _, cost, weights) = _descend(scene, system, edge_mm, refine_lens, iterations)
        steps += taken
    after = rms_px(scene.residuals(seen))
    return scene, SolveInfo(steps, cost, before, after, weights, H, excess)


System = tuple[Floats, Floats, float, Floats]


def _descend(
    scene: MarkerScene,
    system: Callable[[MarkerScene], System],
    edge_mm: float,
    refine_lens: bool,
    iterations: int,
) -> tuple[MarkerScene, int, System]:
    """Levenberg-Marquardt until a step gains less than a ten-millionth."""
    damping, taken = 1e-4, 0
    current = system(scene)
    for taken in range(1, iterations + 1):  # noqa: B007
        H, g, cost, _ = current
        step: Floats = np.asarray(np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-12), -g), float)
        if not np.isfinite(step).all():
            break
        moved = _apply(scene, step, edge_mm, refine_lens)
        trial = system(moved)
        if trial[2] < cost:
            scene, current = moved, trial
            damping = max(damping / 5, 1e-9)
            if cost - trial[2] < 1e-7 * cost:
                break
        else:
            damping *= 8
            if damping > 1e8:
                break
    return scene, taken, current


def _normal_equations(
    scene: MarkerScene,
    seen: Observations,
    edge_mm: float,
    refine_lens: bool,
    robust: bool,
    prior_focal: float,
    focal_sd: float,
) -> System:
    """Normal matrix, gradient, robust cost, and mean weight (M,) of each observation."""
    lens, poses = scene.lens, scene.poses
    P, Q = len(poses), len(scene.corners)
    size = 12 if scene.squares is None else 6
    M = len(seen.photo)
    Rp = np.stack([p.R for p in poses])[seen.photo]
    tp = np.stack([p.t for p in poses])[seen.photo]
    X = scene.corners[seen.marker]
    turned = np.einsum("mij,mcj->mci", Rp, X)
    cam = turned + tp[:, None]
    residual, d_cam, d_lens = _projection(lens, cam, seen.corners_px)
    sigma = seen.sigma_px[:, None, None]
    # per observation: 8 rows; columns lens | photo (6) | marker (size)
    J_photo = np.concatenate([-d_cam @ skew(turned), d_cam], -1)  # left perturbation of the rotation
    d_point = np.einsum("mcij,mjk->mcik", d_cam, Rp)
    if scene.squares is None:
        J_marker = np.zeros((M, 4, 2, 12))
        for c in range(4):
            J_marker[:, c, :, 3 * c : 3 * c + 3] = d_point[:, c]
    else:
        Rm = np.stack([s.R for s in scene.squares])[seen.marker]
        arm = np.einsum("mij,cj->mci", Rm, square_corners(edge_mm))
        J_marker = np.concatenate([-d_point @ skew(arm), d_point], -1)
    norm = np.sqrt((residual**2).sum(-1)) / sigma[..., 0]
    weights = np.minimum(1.0, HUBER / np.maximum(norm, 1e-12)) if robust else np.ones_like(norm)
    cost = float((np.where(norm < HUBER, norm**2, 2 * HUBER * norm - HUBER**2) if robust else norm**2).sum())
    root = (np.sqrt(weights) / sigma[..., 0])[..., None]
    r = (residual * root).reshape(M, 8)
    Jl = (d_lens * root[..., None]).reshape(M, 8, LENS)
    Jp = (J_photo * root[..., None]).reshape(M, 8, 6)
    Jm = (J_marker * root[..., None]).reshape(M, 8, size)
    offset_m = LENS + 6 * P
    n = offset_m + size * Q
    J = np.concatenate([Jl, Jp, Jm], -1)
    blocks = np.einsum("mri,mrj->mij", J, J)
    gradient = np.einsum("mri,mr->mi", J, r)
    columns = np.concatenate(
        [
            np.tile(np.arange(LENS), (M, 1)),
            LENS + 6 * seen.photo[:, None] + np.arange(6),
            offset_m + size * seen.marker[:, None] + np.arange(size),
        ],
        axis=1,
    )
    flat = columns[:, :, None] * n + columns[:, None, :]
    H = np.asarray(np.bincount(flat.ravel(), blocks.ravel(), n * n), float).reshape(n, n)
    g = np.asarray(np.bincount(columns.ravel(), gradient.ravel(), n), float)
    deviation = np.array(
        [
            np.log(lens.focal_px / prior_focal),
            lens.cx - (lens.width - 1) / 2,
            lens.cy - (lens.height - 1) / 2,
            lens.k1,
            lens.k2,
        ]
    )
    sd = np.array([focal_sd, PRIOR_CENTRE * lens.width, PRIOR_CENTRE * lens.width, *PRIOR_RADIAL])
    if refine_lens:
        H[range(LENS), range(LENS)] += 1 / sd**2
        g[:LENS] += deviation / sd**2
        cost += float(((deviation / sd) ** 2).sum())
    else:
        H[:LENS], H[:, :LENS], g[:LENS] = 0, 0, 0
        H[range(LENS), range(LENS)] = 1.0
    return H, g, cost, weights.mean(1)


def _projection(lens: Intrinsics, cam: Floats, measured: Floats) -> tuple[Floats, Floats, Floats]:
    """Residual (M, 4, 2), its derivative by the camera point (M, 4, 2, 3) and by the lens (M, 4, 2, 5)."""
    z = np.where(np.abs(cam[..., 2]) < 1e-6, 1e-6, cam[..., 2])
    xy = cam[..., :2] / z[..., None]
    r2 = (xy * xy).sum(-1)
    radial = 1 + r2 * (lens.k1 + r2 * lens.k2)
    f = lens.focal_px
    offset = f * xy * radial[..., None]
    residual = offset + np.array([lens.cx, lens.cy]) - measured
    d_xy = f * (
        radial[..., None, None] * np.eye(2)
        + 2 * (lens.k1 + 2 * lens.k2 * r2)[..., None, None] * xy[..., :, None] * xy[..., None, :]
    )
    d_cam = np.zeros((*xy.shape, 3))
    d_cam[..., :2] = d_xy / z[..., None, None]
    d_cam[..., 2] = -(d_xy @ xy[..., None])[..., 0] / z[..., None]
    d_lens = np.zeros((*xy.shape, LENS))
    d_lens[..., 0] = offset
    d_lens[..., 0, 1] = d_lens[..., 1, 2] = 1
    d_lens[..., 3] = f * xy * r2[..., None]
    d_lens[..., 4] = f * xy * (r2**2)[..., None]
    return residual, d_cam, d_lens


def _turn(pose: Pose, step: Floats) -> Pose:
    R = rotation_from_vector(step[:3]) @ pose.R
    u, _, vt = np.linalg.svd(R)
    return Pose(u @ vt, pose.t + step[3:])


def _apply(scene: MarkerScene, step: Floats, edge_mm: float, refine_lens: bool) -> MarkerScene:
    lens = scene.lens
    if refine_lens:
        lens = replace(
            lens,
            focal_px=lens.focal_px * float(np.exp(np.clip(step[0], -0.3, 0.3))),
            cx=lens.cx + float(step[1]),
            cy=lens.cy + float(step[2]),
            k1=lens.k1 + float(step[3]),
            k2=lens.k2 + float(step[4]),
        )
    P = len(scene.poses)
    photo_steps = step[LENS : LENS + 6 * P].reshape(P, 6)
    poses = tuple(_turn(p, s) for p, s in zip(scene.poses, photo_steps, strict=True))
    rest = step[LENS + 6 * P :]
    if scene.squares is None:
        return MarkerScene(lens, poses, scene.corners + rest.reshape(-1, 4, 3), None)
    squares = tuple(_turn(s, d) for s, d in zip(scene.squares, rest.reshape(-1, 6), strict=True))
    return MarkerScene(lens, poses, corners_of(squares, edge_mm), squares)


def corners_of(squares: tuple[Pose, ...], edge_mm: float) -> Floats:
    """World corners (Q, 4, 3) mm of square markers with poses ``world_from_marker``."""
    return np.stack([s.apply(square_corners(edge_mm)) for s in squares])

"""The least squares behind stages 1 and 2: cameras and markers from marker corners.

Unknowns: a shared lens (focal length, principal point, two radial terms), a pose per photo, and the markers, either
rigid squares of known edge (a pose each) or four free points each. With ``growth`` also by how many pixels black has
grown at the markers' edges, in all photos alike and in each on its own: exposure, blur and a camera's tone move all
edges of a photo outward or inward together, which a known edge would otherwise turn into an error of scale that no
number of photos averages out. Derivatives are analytic; the normal equations
(:mod:`specimap_core.bundle_adjust.normal_equations`) are solved for lens and markers first. Robustness is by
reweighting (Huber 1964 on whole markers' corners); Levenberg-Marquardt damping also takes care of the free choice of
frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.normal_equations import Assembly, damped_step
from specimap_core.fiducials.observations import Observations, corner_shifts, corners_of, square_corners
from specimap_core.geometry.cameras import Intrinsics, Pose, rotation_from_vector, skew
from specimap_core.geometry.projection import LENS, projection_derivatives
from specimap_core.geometry.robust import MEDIAN_OF_RAYLEIGH

PRIOR_FOCAL = 0.05
"""Standard deviation of the logarithm of a focal length that EXIF states."""
PRIOR_CENTRE = 0.003
"""Standard deviation of the principal point about the image's centre, as a share of the width."""
PRIOR_RADIAL = (0.1, 0.1)
GROWTH_PX = 0.03
"""Standard deviation by which black has grown at the edges of all photos' markers."""
PHOTO_GROWTH_PX = 0.03
"""Of the same in one photo against the others."""
HUBER = 2.5
"""Residuals beyond this many standard deviations lose weight."""
NOISE_ROUNDS = 3
"""How often the scatter of the corners is estimated anew; large at first, so that a rough start is forgiven."""


@dataclass(frozen=True)
class MarkerScene:
    """A state of the unknowns: one lens, P photo poses, and the corners (Q, 4, 3) of Q markers.

    ``squares``: poses ``world_from_marker`` of the markers where they are rigid, else None. ``growth_px`` (1 + P,): by
    how much black has grown at the markers' edges, in all photos and beyond that in each; None where it is no unknown.
    """

    lens: Intrinsics
    poses: tuple[Pose, ...]
    corners: Floats
    squares: tuple[Pose, ...] | None
    growth_px: Floats | None = None

    def residuals(self, seen: Observations) -> Floats:
        """Projected minus measured corners, (M, 4, 2) pixels."""
        R = np.stack([p.R for p in self.poses])[seen.photo]
        t = np.stack([p.t for p in self.poses])[seen.photo]
        cam = np.einsum("mij,mcj->mci", R, self.corners[seen.marker]) + t[:, None]
        residuals = self.lens.project(cam) - seen.corners_px
        if self.growth_px is None:
            return residuals
        grown = self.growth_px[0] + self.growth_px[1:][seen.photo]
        return np.asarray(residuals + grown[:, None, None] * corner_shifts(seen.corners_px))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Unknowns that all share, of a photo, and of a marker."""
        grows = self.growth_px is not None
        return LENS + grows, 6 + grows, 12 if self.squares is None else 6


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
    growth: bool = False,
    focal_prior_px: float | None = None,
    iterations: int = 60,
) -> tuple[MarkerScene, SolveInfo]:
    """Minimise the weighted reprojection error.

    Rigid where ``scene.squares`` is given (millimetres follow from ``edge_mm``), else free corners, whose scale
    stays as it is. With ``refine_lens`` false the lens is fixed, as published.
    """
    before = rms_px(scene.residuals(seen))
    scene = replace(scene, growth_px=np.zeros(1 + len(scene.poses)) if growth else None)
    prior_focal = focal_prior_px or scene.lens.focal_px
    focal_sd = PRIOR_FOCAL if focal_prior_px else 10.0
    given, steps, assembly = seen, 0, _assembly(scene, seen)
    for _ in range(NOISE_ROUNDS if robust else 1):
        # What the corners scatter by beyond their own sigma (an uneven print, a lens that two terms do not
        # describe) is noise all the same; unless it is counted, the priors have no say.
        norm = np.sqrt((scene.residuals(given) ** 2).sum(-1)) / given.sigma_px[:, None]
        excess = max(1.0, float(np.median(norm)) / MEDIAN_OF_RAYLEIGH)
        seen = replace(given, sigma_px=given.sigma_px * excess)
        system = partial(
            _normal_equations,
            seen=seen,
            assembly=assembly,
            edge_mm=edge_mm,
            refine_lens=refine_lens,
            robust=robust,
            prior_focal=prior_focal,
            focal_sd=focal_sd,
        )
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
        step = damped_step(H, g, damping, (scene.sizes[0], len(scene.poses), scene.sizes[1]))
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


def _assembly(scene: MarkerScene, seen: Observations) -> Assembly:
    """Unknowns: lens, growth | photos (pose, growth) | markers."""
    shared, photo, size = scene.sizes
    markers = shared + photo * len(scene.poses)
    parts = (
        np.tile(np.arange(shared), (len(seen.photo), 1)),
        shared + photo * seen.photo[:, None] + np.arange(photo),
        markers + size * seen.marker[:, None] + np.arange(size),
    )
    return Assembly(np.concatenate(parts, axis=1), markers + size * len(scene.corners))


def _normal_equations(
    scene: MarkerScene,
    seen: Observations,
    assembly: Assembly,
    edge_mm: float,
    refine_lens: bool,
    robust: bool,
    prior_focal: float,
    focal_sd: float,
) -> System:
    """Normal matrix, gradient, robust cost, and mean weight (M,) of each observation."""
    lens, poses = scene.lens, scene.poses
    M, (shared, photo, size) = len(seen.photo), scene.sizes
    Rp = np.stack([p.R for p in poses])[seen.photo]
    tp = np.stack([p.t for p in poses])[seen.photo]
    X = scene.corners[seen.marker]
    turned = X @ Rp.transpose(0, 2, 1)
    cam = turned + tp[:, None]
    residual, d_cam, d_lens = projection_derivatives(lens, cam, seen.corners_px)
    sigma = seen.sigma_px[:, None, None]
    # per observation: 8 rows; columns lens, growth | photo (6), growth | marker (size)
    J_photo = np.concatenate([-d_cam @ skew(turned), d_cam], -1)  # left perturbation of the rotation
    if scene.growth_px is not None:
        by_growth = corner_shifts(seen.corners_px)[..., None]
        residual = residual + (scene.growth_px[0] + scene.growth_px[1:][seen.photo])[:, None, None] * by_growth[..., 0]
        d_lens, J_photo = np.concatenate([d_lens, by_growth], -1), np.concatenate([J_photo, by_growth], -1)
    d_point = d_cam @ Rp[:, None]
    if scene.squares is None:
        J_marker = np.zeros((M, 4, 2, 12))
        for c in range(4):
            J_marker[:, c, :, 3 * c : 3 * c + 3] = d_point[:, c]
    else:
        Rm = np.stack([s.R for s in scene.squares])[seen.marker]
        arm = square_corners(edge_mm) @ Rm.transpose(0, 2, 1)
        J_marker = np.concatenate([-d_point @ skew(arm), d_point], -1)
    norm = np.sqrt((residual**2).sum(-1)) / sigma[..., 0]
    weights = np.minimum(1.0, HUBER / np.maximum(norm, 1e-12)) if robust else np.ones_like(norm)
    cost = float((np.where(norm < HUBER, norm**2, 2 * HUBER * norm - HUBER**2) if robust else norm**2).sum())
    root = (np.sqrt(weights) / sigma[..., 0])[..., None]
    r = (residual * root).reshape(M, 8)
    Jl = (d_lens * root[..., None]).reshape(M, 8, shared)
    Jp = (J_photo * root[..., None]).reshape(M, 8, photo)
    Jm = (J_marker * root[..., None]).reshape(M, 8, size)
    H, g = assembly(np.concatenate([Jl, Jp, Jm], -1), r)
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
    if scene.growth_px is not None:
        at = np.r_[LENS, shared + photo * np.arange(1, len(poses) + 1) - 1]
        sd = np.r_[GROWTH_PX, np.full(len(poses), PHOTO_GROWTH_PX)]
        H[at, at] += 1 / sd**2
        g[at] += scene.growth_px / sd**2
        cost += float(((scene.growth_px / sd) ** 2).sum())
    return H, g, cost, weights.mean(1)


def _stepped(poses: tuple[Pose, ...], steps: Floats) -> tuple[Pose, ...]:
    """Poses turned from the left and shifted by ``steps`` (N, 6)."""
    u, _, vt = np.linalg.svd(rotation_from_vector(steps[:, :3]) @ np.stack([p.R for p in poses]))
    return tuple(Pose(R, p.t + t) for R, p, t in zip(u @ vt, poses, steps[:, 3:], strict=True))


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
    P, (shared, photo, _) = len(scene.poses), scene.sizes
    each = step[shared : shared + photo * P].reshape(P, photo)
    poses = _stepped(scene.poses, each[:, :6])
    grown = None if scene.growth_px is None else scene.growth_px + np.r_[step[LENS], each[:, 6]]
    rest = step[shared + photo * P :]
    if scene.squares is None:
        return MarkerScene(lens, poses, scene.corners + rest.reshape(-1, 4, 3), None, grown)
    squares = _stepped(scene.squares, rest.reshape(-1, 6))
    return MarkerScene(lens, poses, corners_of(squares, edge_mm), squares, grown)

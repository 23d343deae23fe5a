"""Predict photos' patches from other photos through the finished surface and cameras, and measure how far they are off.

A patch of the surface is looked up in all photos that see it. The photos that the surface was refined on give, by their
mean, what each other photo should show; that photo's own patch is aligned with it (Lucas and Kanade 1981, with a free
gain and offset), in the plane that touches the surface. A surface that is off by d along its normal moves the patch
of each photo by d times the slope of its line of sight; what remains is an error of pose, lens or measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Ints, Singles
from specimap_core.geometry.image_sampling import sample
from specimap_core.surface.photo_consistency import Photographs
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.refinement import pixel_footprint_mm
from specimap_core.verification.sites import Sites, tangents

HALF = 4
"""A patch is (2 HALF + 1)^2 samples, a photo's pixel apart on the surface."""
SIGMA_SAMPLES = 2.0
"""Standard deviation of a patch's weights. On phantoms, larger patches miss more of the error, smaller ones drown."""
RELIEF_MM = 1.5
"""Samples whose surface lies farther from the touching plane belong to another one."""
STEPS = 6
REACH_SAMPLES = 3.0
"""A patch that seems farther off matches something else."""
STILL_SAMPLES = 0.05
LEAST_CORRELATION = 0.7
LEAST_GAIN = 0.1
LEAST_PREDICTING = 3
"""Photos that a prediction needs."""
NOISE_VARIANCE = 1.0
"""Grey levels squared that a patch is given on top of its own, so that plain ones do not gain weight."""
STEP_MM = 0.05
"""For the derivatives of the projection."""


@dataclass(frozen=True)
class Displacements:
    """E patches, aligned: ``site`` (E,), ``photo`` (E,); by how much each is displaced, ``shift_mm`` (E, 2) along the
    site's tangents, with ``covariance`` (E, 2, 2); ``slope`` (E, 2): displacement for each mm by which the surface lies
    too low; ``px_per_mm`` (E, 2, 2): from the tangents to the photo's pixels. ``tried`` (V,): patches of each photo
    that were to be aligned; the others resemble no prediction, highlights among them."""

    site: Ints
    photo: Ints
    shift_mm: Floats
    covariance: Floats
    slope: Floats
    px_per_mm: Floats
    tried: Ints


@dataclass(frozen=True)
class _Patches:
    """One entry for each photo of each site, those of a photo together; ``first`` (V + 1,): where its entries begin.

    ``x``, ``y`` (E, S): pixels of the samples, whose ``weight`` is (P, S); ``slope`` (E, 2) of the line of sight.
    """

    site: Ints
    photo: Ints
    first: Ints
    x: Singles
    y: Singles
    px_per_mm: Floats
    slope: Floats
    weight: Floats

    def look(self, photographs: Photographs, shift_mm: Floats) -> Singles:
        """What the photos show (E, S) at the samples moved by ``shift_mm`` (E, 2)."""
        moved = np.einsum("eij,ej->ei", self.px_per_mm, shift_mm).astype(np.float32)
        values = np.empty_like(self.x)
        for v, grey in enumerate(photographs.greys):
            of = slice(self.first[v], self.first[v + 1])
            if of.stop > of.start:
                values[of] = sample(grey.astype(np.float32), self.x[of] + moved[of, :1], self.y[of] + moved[of, 1:])
        return values

    def only(self, chosen: Ints) -> _Patches:
        """Those of the ``chosen`` entries, in ascending order."""
        first = np.searchsorted(self.photo[chosen], np.arange(len(self.first)))
        return _Patches(
            self.site[chosen],
            self.photo[chosen],
            first,
            self.x[chosen],
            self.y[chosen],
            self.px_per_mm[chosen],
            self.slope[chosen],
            self.weight,
        )


@dataclass(frozen=True)
class _Prediction:
    """What the photos should show at P sites.

    ``design`` (P, S, 4): the patch, one, and the patch's derivatives by the tangents, mm; ``solve`` (P, 4, S) fits it
    to values; ``spread`` (P, 2, 2): covariance of the fitted displacement for values of variance 1; ``slope`` (P, 2):
    mean of the photos' that it is made of; ``made`` (P,): whether these are enough.
    """

    design: Floats
    solve: Floats
    spread: Floats
    slope: Floats
    made: NDArray[np.bool_]


def measure(sites: Sites, photographs: Photographs, caster: RayCaster) -> Displacements:
    """Align the patches of photos that the sites' surface was not refined on with their prediction."""
    sample_mm = pixel_footprint_mm(photographs.lens, photographs.poses, sites.points.mean(0))
    patches = _patches(sites, photographs, caster, sample_mm)
    predicting = sites.used[patches.site, patches.photo]
    prediction = _predicted(patches.only(np.flatnonzero(predicting)), photographs, len(sites.points), sample_mm)
    tested = patches.only(np.flatnonzero(~predicting & prediction.made[patches.site]))
    return _aligned(tested, prediction, photographs, sample_mm)


def _patches(sites: Sites, photographs: Photographs, caster: RayCaster, sample_mm: float) -> _Patches:
    lens, points, normals = photographs.lens, sites.points, sites.normals
    side = np.arange(-HALF, HALF + 1, dtype=float)
    across, along = (g.ravel() for g in np.meshgrid(side, side))
    both = tangents(normals)
    plane = sample_mm * (across[None, :, None] * both[0][:, None] + along[None, :, None] * both[1][:, None])
    # The surface's own relief: a plane would flatten the patch, and be off in proportion.
    above = (points + RELIEF_MM * normals)[:, None] + plane
    down = np.broadcast_to(-normals[:, None], plane.shape)
    there = caster.cast(above.reshape(-1, 3), down.reshape(-1, 3)).xyz.reshape(plane.shape).astype(float)
    height = ((there - points[:, None]) * normals[:, None]).sum(-1)
    known = np.isfinite(height) & (np.abs(height) < RELIEF_MM)
    there = np.where(known[..., None], there, points[:, None] + plane)
    weight = np.exp(-(across**2 + along**2) / (2 * SIGMA_SAMPLES**2)) * known

    photo, site = np.nonzero(sites.seen.T)
    first = np.searchsorted(photo, np.arange(len(photographs.poses) + 1))
    x, y = np.empty((2, len(site), len(across)), np.float32)
    px_per_mm, slope = np.empty((len(site), 2, 2)), np.empty((len(site), 2))
    for v, pose in enumerate(photographs.poses):
        of = slice(first[v], first[v + 1])
        s = site[of]
        pixels = lens.project(pose.apply(there[s]))
        x[of], y[of] = pixels[..., 0], pixels[..., 1]
        away = pose.centre - points[s]
        up = (away * normals[s]).sum(1)
        for k, tangent in enumerate(both):
            ahead, back = (lens.project(pose.apply(points[s] + step * tangent[s])) for step in (STEP_MM, -STEP_MM))
            px_per_mm[of, :, k] = (ahead - back) / (2 * STEP_MM)
            slope[of, k] = -(away * tangent[s]).sum(1) / up
    return _Patches(site, photo, first, x, y, px_per_mm, slope, weight)


def _predicted(used: _Patches, photographs: Photographs, count: int, sample_mm: float) -> _Prediction:
    values = used.look(photographs, np.zeros((len(used.site), 2)))
    weight = used.weight[used.site]
    total = np.maximum(weight.sum(1), 1e-9)
    centred = values - ((weight * values).sum(1) / total)[:, None]
    contrast = np.sqrt((weight * centred**2).sum(1) / total + NOISE_VARIANCE)
    number = np.maximum(np.bincount(used.site, minlength=count), 1)

    def mean(of_entries: Floats) -> Floats:
        out = np.zeros((count, *of_entries.shape[1:]))
        np.add.at(out, used.site, of_entries)
        return np.asarray(out / number.reshape(-1, *(1,) * (out.ndim - 1)))

    # Photos differ in exposure: each counts by its own contrast.
    patch = mean(centred / contrast[:, None]) * mean(contrast)[:, None]
    n = 2 * HALF + 1
    square = patch.reshape(count, n, n)
    by_along, by_across = (np.asarray(np.gradient(square, sample_mm, axis=k)) for k in (1, 2))
    parts = patch, np.ones_like(patch), by_across.reshape(count, -1), by_along.reshape(count, -1)
    design = np.stack(parts, -1)
    weighted = used.weight[..., None] * design
    inverse = np.linalg.inv(np.einsum("psi,psj->pij", weighted, design) + 1e-9 * np.eye(4))
    solve = np.einsum("pij,psj->pis", inverse, weighted)
    spread = np.einsum("pis,pjs->pij", solve[:, 2:], solve[:, 2:])
    made = np.bincount(used.site, minlength=count) >= LEAST_PREDICTING
    return _Prediction(design, solve, spread, mean(used.slope), made)


def _aligned(tested: _Patches, prediction: _Prediction, photographs: Photographs, sample_mm: float) -> Displacements:
    site = tested.site
    shift, step = np.zeros((len(site), 2)), np.zeros((len(site), 2))
    for _ in range(STEPS):
        fitted = np.einsum("eis,es->ei", prediction.solve[site], tested.look(photographs, shift))
        step = -fitted[:, 2:] / np.maximum(fitted[:, :1], LEAST_GAIN)
        step = np.clip(step, -sample_mm, sample_mm)
        shift += step
    values, design = tested.look(photographs, shift), prediction.design[site]
    fitted = np.einsum("eis,es->ei", prediction.solve[site], values)
    weight = tested.weight[site]
    total = np.maximum(weight.sum(1, keepdims=True), 1e-9)
    missing = values - np.einsum("esi,ei->es", design, fitted)
    variance = (weight * missing**2).sum(1) / total[:, 0]

    def centred(patch: Floats | Singles) -> Floats:
        return np.asarray(patch - (weight * patch).sum(1, keepdims=True) / total)

    seen, expected = centred(values), centred(design[..., 0])
    norm = np.sqrt((weight * seen**2).sum(1) * (weight * expected**2).sum(1))
    alike = (weight * seen * expected).sum(1) / np.maximum(norm, 1e-9) > LEAST_CORRELATION
    still = np.abs(step).max(1, initial=0) < STILL_SAMPLES * sample_mm
    good = np.flatnonzero(alike & still & (np.abs(shift).max(1, initial=0) < REACH_SAMPLES * sample_mm))
    gain = np.maximum(fitted[good, 0], LEAST_GAIN)
    return Displacements(
        site[good],
        tested.photo[good],
        shift[good],
        prediction.spread[site[good]] * (variance[good] / gain**2)[:, None, None],
        (tested.slope - prediction.slope[site])[good],
        tested.px_per_mm[good],
        np.diff(tested.first),
    )

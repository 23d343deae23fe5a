"""The certificate of a result: the errors that unused evidence shows, and the verdict that rests on them.

Limits were set on own phantoms of seeds 101 and 102, phantom A and phantom hard, in order and with planted faults, and
judged on others: docs/accuracy.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from specimap_core.cloud import CloudPoints, Flag
from specimap_core.cube import Cube
from specimap_core.notices import Notice, few_of
from specimap_core.register.motion_repair import moved_mesh
from specimap_core.register.registration import Registered
from specimap_core.register.tile_offsets import measure_tile_offsets
from specimap_core.surface.photo_consistency import Photographs
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.refinement import pixel_footprint_mm
from specimap_core.surface.settings import RefineSettings
from specimap_core.verification.cube_picture import check_bands, check_registration
from specimap_core.verification.figures import (
    BandsCheck,
    Certificate,
    RegistrationCheck,
    SeenError,
    SurfaceCheck,
    Verdict,
)
from specimap_core.verification.held_out import measure
from specimap_core.verification.sites import Sites, sites_of
from specimap_core.verification.surface_check import check_surface

REACH_MM = 3.0
"""Farther off, a specimen has been found and followed before."""
MEDIAN_OF_SIGMA = 0.72
"""Median error over ``sigma_mm`` where that holds: 68 % of the errors lie within one, as the tables have it."""
DOUBTED = 1.15
"""Seen errors are right to a fifth: what exceeds the stated one by less changes nothing."""
MOST_PHOTO_SHIFT_PX = 0.35
MOST_LEAN_PX = 0.25
MOST_UNLIKE = 0.85
MOST_TOTAL_MM = 0.2
MOST_OF_CUBE_MM = 0.12
MOST_BAND_PX = 0.1
BAND_SIGMAS = 5.0
CONTRADICTED = ("photos_contradict", "surface_leans", "photos_unpredicted")
"""What these say puts everything in doubt: the result is not trusted."""
DOUBTS = (
    "photo_contradicts",
    "surface_unchecked",
    "seen_error_large",
    "cube_picture_off",
    "cube_camera_loose",
    "cube_camera_unfit",
    "corners_scatter",
    "cube_corners_scatter",
    "specimen_not_found",
    "scale_implausible",
    "scale_contradicts_exif",
)


@dataclass(frozen=True, eq=False)
class Verification:
    """What was checked of a result, and the ``sigma_mm`` (P,) that it stated at the places."""

    surface: SurfaceCheck
    registration: RegistrationCheck | None
    bands: BandsCheck | None
    by_camera: bool
    stated_mm: float

    @property
    def total_mm(self) -> SeenError | None:
        """Surface and registration together."""
        surface, registration = self.surface.seen_mm, self.registration
        if surface is None or registration is None:
            return surface
        aside = registration.seen_mm
        return SeenError(
            median=float(np.hypot(surface.median, aside.median)), p95=float(np.hypot(surface.p95, aside.p95))
        )

    @property
    def sigma_factor(self) -> float:
        """By how much the stated standard deviation is too small, as far as that is certain."""
        total = self.total_mm
        if total is None or not self.by_camera or not self.stated_mm > 0:
            return 1.0
        return max(1.0, total.median / (MEDIAN_OF_SIGMA * self.stated_mm) / DOUBTED)

    def scaled(self, points: CloudPoints) -> CloudPoints:
        """The points, those of the specimen with the standard deviation that was seen."""
        factor = np.where(points.flags & Flag.SPECIMEN, np.float32(self.sigma_factor), np.float32(1))
        return replace(points, sigma_mm=(points.sigma_mm * factor).astype(np.float32))

    def warnings(self) -> list[Notice]:
        """Those that the figures call for."""
        return [*_of_surface(self.surface), *self._of_cube(), *_of_bands(self.bands)]

    def _of_cube(self) -> list[Notice]:
        found, total, registration = [], self.total_mm, self.registration
        if self.by_camera and total is not None and total.median > MOST_TOTAL_MM:
            text = f"Photos and cube that the result was not made from show errors of {total.median:.2f} mm (median)."
            found.append(Notice("seen_error_large", text))
        if self.by_camera and registration is not None and registration.seen_mm.median > MOST_OF_CUBE_MM:
            text = (
                f"The cube's picture lies {registration.seen_mm.median:.2f} mm from where the photos' colours show it."
            )
            found.append(Notice("cube_picture_off", text))
        return found

    def certificate(self, codes: Collection[str]) -> Certificate:
        """The certificate of a result whose warnings have these ``codes``."""
        reasons = [code for code in (*CONTRADICTED, *DOUBTS) if code in codes]
        verdict: Verdict = "trusted"
        if reasons:
            verdict = "not_trusted" if reasons[0] in CONTRADICTED else "doubtful"
        return Certificate(
            verdict=verdict,
            reasons=reasons,
            total_mm=self.total_mm,
            surface=self.surface,
            registration=self.registration,
            bands=self.bands,
            sigma_factor=self.sigma_factor,
        )


def verify(
    registered: Registered,
    greys: tuple[NDArray[np.uint8], ...],
    names: Sequence[str],
    cube: Cube,
    settings: RefineSettings,
    progress: Callable[[float], None] = lambda share: None,
) -> Verification:
    """Check a registered result against the cube and the ``greys`` (H, W) of its photos, which have ``names``."""
    surface, camera, markers = registered.surface, registered.camera, registered.markers
    adjusted, caster = surface.adjusted, surface.caster
    photographs = Photographs(list(greys), adjusted.lens, adjusted.poses[: len(greys)])
    sites = sites_of(registered.points, caster, photographs, settings)
    progress(0.3)
    of_surface = _checked_surface(sites, photographs, caster, names)
    progress(0.5)
    by_camera = registered.method == "camera"
    of_cube = None
    if by_camera:
        there = caster
        if camera.followed is not None:
            there = RayCaster(moved_mesh(caster.mesh, camera.followed.motion, adjusted.corners))
        view = camera.camera.view
        image, mirrored = markers.image, markers.mirrored
        tiles = measure_tile_offsets(image, view, there, adjusted.corners, mirrored=mirrored, reach_mm=REACH_MM)
        of_cube = None if tiles is None else check_registration(tiles)
    progress(0.8)
    bands = check_bands(cube, markers.corners_px)
    progress(1.0)
    stated = float(np.median(sites.sigma_mm)) if len(sites.sigma_mm) else 0.0
    return Verification(of_surface, of_cube, bands, by_camera, stated)


def _checked_surface(sites: Sites, photographs: Photographs, caster: RayCaster, names: Sequence[str]) -> SurfaceCheck:
    if not sites.seen.any():
        return SurfaceCheck(
            places=len(sites.points),
            checked=0,
            patches=0,
            unlike=0.0,
            offset_mm=None,
            lean_mm=None,
            seen_mm=None,
            photo_shift_px=None,
            pixel_mm=0.0,
        )
    pixel_mm = pixel_footprint_mm(photographs.lens, photographs.poses, sites.points.mean(0))
    return check_surface(sites, measure(sites, photographs, caster), pixel_mm, names)


def _of_surface(found: SurfaceCheck) -> list[Notice]:
    warnings = []
    if found.photo_shift_px is not None and found.photo_shift_px > MOST_PHOTO_SHIFT_PX:
        text = f"Photos show the specimen {found.photo_shift_px:.1f} px (RMS) from where the other photos predict it."
        warnings.append(Notice("photos_contradict", text))
    if found.photos_off:
        text = (
            "These photos do not show the specimen where the other photos predict it; their poses are wrong, something"
            f" moved, or they were edited: {few_of(found.photos_off)}."
        )
        warnings.append(Notice("photo_contradicts", text))
    if found.lean_mm is not None and abs(found.lean_mm) > MOST_LEAN_PX * found.pixel_mm:
        where = "low" if found.lean_mm > 0 else "high"
        text = f"The whole surface seems to lie {abs(found.lean_mm):.2f} mm too {where}, as unused photos show it."
        warnings.append(Notice("surface_leans", text))
    if found.seen_mm is None:
        text = (
            f"Only {found.checked} places of the specimen could be checked with photos that did not make the surface."
        )
        warnings.append(Notice("surface_unchecked", text))
    if found.patches and found.unlike > MOST_UNLIKE:
        text = f"{100 * found.unlike:.0f} % of the photos' patches do not resemble what the other photos predict."
        warnings.append(Notice("photos_unpredicted", text))
    return warnings


def _of_bands(found: BandsCheck | None) -> list[Notice]:
    if found is None:
        return []
    off = float(np.hypot(found.shift_px, found.growth_px))
    if off <= max(MOST_BAND_PX, BAND_SIGMAS * found.sigma_px):
        return []
    text = (
        f"The last third of the cube's bands lies {off:.1f} px from the first: {found.shift_px:.2f} px in the middle,"
        f" {found.growth_px:.2f} px more at the markers."
    )
    return [Notice("bands_shifted", text)]

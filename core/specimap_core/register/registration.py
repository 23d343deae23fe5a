"""Stage 4: register a cube to the surface, by its solved camera or by the published homography."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.cloud import CloudPoints
from specimap_core.cube import Cube
from specimap_core.notices import Notices
from specimap_core.register.accuracy import camera_figures, homography_figures
from specimap_core.register.camera_refinement import RefinedCamera, refine_camera
from specimap_core.register.corners import corners_in_cube
from specimap_core.register.cube_markers import CubeMarkers, find_markers, unmirrored
from specimap_core.register.figures import MethodFigures
from specimap_core.register.joint_layout import JointLayout, join_cube
from specimap_core.register.motion_repair import at_rest, moved_mesh, seen_at_rest
from specimap_core.register.placement import (
    Homography,
    fit_homography,
    homography_xyz,
    place_by_camera,
    place_by_homography,
)
from specimap_core.register.points import cloud_points
from specimap_core.register.settings import Method, RegisterSettings
from specimap_core.render.orthographic import Grid
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import raised_places


@dataclass(frozen=True)
class Surface:
    """What a cube is registered to: the ``adjusted`` cameras and corners, the mesh in ``caster`` with ``sigma_mm`` (V,)
    of its vertices, and the ``coarse`` and ``fine`` grids of it."""

    adjusted: Adjusted
    sigma_mm: Floats
    caster: RayCaster
    coarse: Grid
    fine: Grid

    def scaled(self, joint: JointLayout) -> Surface:
        """The same at the scale and with the corners of photos and cube together. The grids, which the published method
        alone uses, stay those of the photos."""
        mesh = self.caster.mesh
        vertices = (mesh.vertices * joint.scale).astype(np.float32)
        return replace(self, adjusted=joint.adjusted, caster=RayCaster(replace(mesh, vertices=vertices)))


@dataclass(frozen=True)
class Registered:
    """A registered cube: its ``points`` by ``method`` on the ``surface``, which that method may have scaled, the
    ``markers`` found in it, its ``camera``, the ``homography``, the ``figures`` of both methods, and ``parallax_mm``
    (S,), how far apart the methods put each point, NaN where one of them does not; ``warnings`` for the report."""

    method: Method
    surface: Surface
    markers: CubeMarkers
    camera: RefinedCamera
    homography: Homography
    figures: Mapping[str, MethodFigures]
    points: CloudPoints
    parallax_mm: NDArray[np.float32]
    warnings: Notices


def register_cube(
    cube: Cube,
    surface: Surface,
    dictionary: str,
    settings: RegisterSettings,
    *,
    join: bool = True,
    progress: Callable[[float], None] = lambda share: None,
) -> Registered:
    """Register a cube whose markers are of ``dictionary``. With ``join`` its corners correct the layout of the photos.

    Raises:
        MarkersMissingInCubeError, DuplicateMarkersError: the cube's markers do not suffice.
        RegistrationError: no camera, or no homography, fits them.
    """
    grids = surface.coarse, surface.fine
    markers = find_markers(cube, dictionary, surface.adjusted.marker_ids)
    progress(0.25)
    by_photos = corners_in_cube(markers, surface.adjusted, cube.cols)
    if not join:
        by_photos = replace(by_photos, covariance=None)
    homography = fit_homography(*by_photos.flat()[:2], surface.coarse, settings.ransac_px)
    joint = join_cube(by_photos, surface.adjusted, cube.rows, cube.cols)
    by_camera = settings.method == "camera"
    if by_camera:
        surface = surface.scaled(joint)
    adjusted, caster = surface.adjusted, surface.caster
    refined = refine_camera(joint.seen, joint.by_corners, markers, caster, adjusted.corners)
    camera = refined.camera
    seen = corners_in_cube(markers, adjusted, cube.cols)
    seen = seen.of(np.isin(seen.marker_ids, joint.seen.marker_ids))
    there = caster
    if refined.followed is not None:
        there = RayCaster(moved_mesh(caster.mesh, refined.followed.motion, adjusted.corners))
    placement = (
        at_rest(place_by_camera(camera.view, there, markers.mirrored), caster)
        if by_camera
        else place_by_homography(homography, *grids, camera.view, caster, markers.mirrored)
    )
    pixels = unmirrored(placement.pixels[:, ::-1].astype(float), markers.mirrored, cube.cols)
    by_other_method = (
        homography_xyz(homography, *grids, pixels) if by_camera else seen_at_rest(camera.view, pixels, there, caster)
    )
    parallax_mm = np.linalg.norm(placement.xyz - by_other_method, axis=1).astype(np.float32)
    progress(0.75)
    points = cloud_points(
        placement,
        caster,
        surface.sigma_mm.astype(np.float32),
        adjusted.corners,
        adjusted.sigma_layout_mm(raised_places(caster.mesh.vertices, adjusted.corners)),
        refined.lateral_sd_mm,
        camera.pixel_mm,
        None if by_camera else parallax_mm,
    )
    progress(0.875)
    figures = {
        "camera": camera_figures(seen, camera.view, caster),
        "homography": homography_figures(by_photos, *grids, settings.ransac_px),
    }
    warnings = (*joint.warnings(), *refined.warnings())
    return Registered(settings.method, surface, markers, refined, homography, figures, points, parallax_mm, warnings)

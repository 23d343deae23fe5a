"""Stage 4, and what is written: mesh, corners, cloud, preview, report."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from specimap_core import __version__
from specimap_core.atomic import write_text
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.cloud import Cloud, CloudPoints, Flag
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.write_summary import Written
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import Cube
from specimap_core.errors import MarkersMissingInCubeError
from specimap_core.fiducials.layout import edge_lengths
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Floats, Pose, View
from specimap_core.json_text import json_text
from specimap_core.notices import Notice
from specimap_core.pipeline.artefacts import Stage1, Stage2
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.corners import cube_corners, photo_corners
from specimap_core.pipeline.outputs import Outputs, staged
from specimap_core.pipeline.run_warnings import run_warnings, with_assumptions
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.pipeline.stages import all_refused
from specimap_core.register.accuracy import CornersInCube, camera_figures, homography_figures, spread
from specimap_core.register.camera_refinement import settle_camera
from specimap_core.register.cube_camera import CubeCamera
from specimap_core.register.cube_markers import CubeMarkers, find_markers
from specimap_core.register.placement import (
    Placement,
    fit_homography,
    homography_xyz,
    place_by_camera,
    place_by_homography,
)
from specimap_core.register.points import cloud_points
from specimap_core.render.orthographic import Grid
from specimap_core.report.model import (
    Coverage,
    CubeCameraFigures,
    EdgeLength,
    Inliers,
    Parallax,
    Photos,
    Refused,
    Report,
    Reprojection,
    SigmaFigures,
)
from specimap_core.report.quality_gates import gated
from specimap_core.surface.mesh_files import write_mesh_ply
from specimap_core.surface.raycast import RayCaster

CUBE_CORNER_FLOOR_PX = 0.03


def register_and_write(
    stage1: Stage1,
    stage2: Stage2,
    caster: RayCaster,
    grids: tuple[Grid, Grid],
    cube: Cube,
    settings: PipelineSettings,
    outputs: Outputs,
    clock: Clock,
    warnings: list[Notice],
    inputs: dict[str, str],
) -> Report:
    """Register the cube, write all results; the report comes last."""
    adjusted, mesh = stage2.adjusted, stage2.mesh
    with clock.stage("register") as progress:
        points, report = _register(stage1, stage2, cube, settings, caster, grids, warnings, inputs, clock, progress)
        report = gated(report, settings.adjust.edge_mm)
        with staged(outputs) as aside:
            write_mesh_ply(aside.mesh, mesh)
            named = zip(adjusted.marker_ids, adjusted.corners, strict=True)
            write_text(aside.corners, json_text({str(i): np.round(c, 6).tolist() for i, c in named}, indent=1))

            def attributes(written: Written) -> dict[str, object]:
                nonlocal report
                report = report.model_copy(update={"warnings": [*report.warnings, *written.warnings()]})
                return {"report": report.summary(), "settings": settings.as_dict(), "inputs": inputs}

            write_cloud(aside.cloud, points, cube, attributes, progress=lambda share: progress(0.4 + 0.5 * share))
            write_preview(Cloud.open(aside.cloud), aside.preview)
            if stage1.sheet:
                aside.sheet.write_bytes(stage1.sheet)
            report = report.model_copy(update={"seconds": clock.so_far()})
            write_text(aside.report, report.text())
    return report


def _register(
    stage1: Stage1,
    stage2: Stage2,
    cube: Cube,
    settings: PipelineSettings,
    caster: RayCaster,
    grids: tuple[Grid, Grid],
    warnings: list[Notice],
    inputs: dict[str, str],
    clock: Clock,
    progress: Callable[[float], None],
) -> tuple[CloudPoints, Report]:
    """Stage 4 up to the writing; what it needs on the way is gone by then."""
    adjusted, (coarse, fine) = stage2.adjusted, grids
    try:
        found = find_markers(cube, settings.reconstruct.dictionary, adjusted.marker_ids)
    except MarkersMissingInCubeError as error:
        raise with_assumptions(error, cube.warnings) from error
    progress(0.1)
    seen = corners_in_cube(found, adjusted, cube.cols)
    settled = settle_camera(seen, found, cube.rows, cube.cols, caster, adjusted.corners)
    camera, flat = settled.camera, seen.flat()
    homography = fit_homography(flat[0], flat[1], coarse, settings.register.ransac_px)
    by_camera = settings.register.method == "camera"
    chosen = (
        place_by_camera(camera.view, caster, found.mirrored)
        if by_camera
        else place_by_homography(homography, coarse, fine, camera.view, caster, found.mirrored)
    )
    pixels = _as_seen(chosen, found.mirrored, cube.cols)
    other = (
        homography_xyz(homography, coarse, fine, pixels)
        if by_camera
        else caster.cast(camera.view.origins(pixels), camera.view.world_rays(pixels)).xyz
    )
    apart = np.linalg.norm(chosen.xyz - other, axis=1).astype(np.float32)
    progress(0.3)
    points = cloud_points(
        chosen,
        caster,
        stage2.sigma_mm.astype(np.float32),
        adjusted.corners,
        float(np.median(adjusted.sigma_corner_mm)),
        settled.sideways_mm,
        camera.pixel_mm,
        None if by_camera else apart,
    )
    progress(0.35)
    figures = {
        "camera": camera_figures(seen, camera.view, caster),
        "homography": homography_figures(seen, coarse, fine, settings.register.ransac_px),
    }
    own = figures[settings.register.method]
    report = Report(
        specimap_version=__version__,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        method=settings.register.method,
        backend=settings.reconstruct.backend,
        adjustment=settings.adjust.form,
        marker_ids=list(adjusted.marker_ids),
        marker_ids_in_cube=list(found.marker_ids),
        corner_2d_mm=own.corner_2d_mm,
        corner_3d_mm=own.corner_3d_mm,
        leave_one_marker_out_mm=own.leave_one_marker_out_mm,
        methods=figures,
        edge_length_mm=triangulated_edges(stage1, adjusted, settings.adjust.edge_mm),
        corner_sigma_mm=float(np.median(adjusted.sigma_corner_mm)),
        reprojection_px=Reprojection(before=adjusted.rms_before_px, after=adjusted.rms_after_px),
        photos=Photos(
            given=len(stage1.names) + len(stage1.refused),
            used=[stage1.names[p] for p in stage1.reconstruction.photos],
            refused=[Refused(**asdict(r)) for r in all_refused(stage1)],
        ),
        inliers=Inliers(
            n=int(homography.inliers.sum()),
            of=len(homography.inliers),
            threshold_px=settings.register.ransac_px,
            threshold_mm=settings.register.ransac_px * settings.render.r_reg_mm,
        ),
        coverage=Coverage(
            between_markers=_coverage(camera.view, found.mirrored, adjusted.corners, chosen, cube),
            points=len(points),
            specimen_points=int(((points.flags & Flag.SPECIMEN) > 0).sum()),
        ),
        parallax_removed_mm=_parallax(apart[(points.flags & Flag.SPECIMEN) > 0]),
        sigma_mm=_sigma(points),
        cube_camera=_camera(camera, found, cube),
        photo_focal_px=adjusted.lens.focal_px,
        seconds=dict(clock.seconds),
        reused_stages=list(clock.reused),
        warnings=[*warnings, *run_warnings(stage1, adjusted, found), *settled.warnings()],
        settings=settings.as_dict(),
        inputs=inputs,
        photo_corners=photo_corners(stage1, adjusted),
        cube_corners=cube_corners(found, adjusted, camera.view, cube.rows, cube.cols),
    )
    return points, report


def corners_in_cube(found: CubeMarkers, adjusted: Adjusted, cols: int) -> CornersInCube:
    """The markers found in a cube of ``cols`` columns with their adjusted corners, columns as the camera saw them."""
    rows = [adjusted.marker_ids.index(i) for i in found.marker_ids]
    pixels = found.corners_px.copy()
    if found.mirrored:
        pixels[..., 0] = cols - 1 - pixels[..., 0]
    return CornersInCube(
        found.marker_ids, adjusted.corners[rows], pixels, np.hypot(found.sigma_px, CUBE_CORNER_FLOOR_PX)
    )


def triangulated_edges(stage1: Stage1, adjusted: Adjusted, expected: float) -> EdgeLength:
    """Edges of corners triangulated one by one: rigid squares would only repeat the known edge."""
    seen = stage1.corners.seen
    place = {photo: k for k, photo in enumerate(stage1.reconstruction.photos)}
    keep = np.isin(seen.photo, stage1.reconstruction.photos)
    kept = seen.of(keep)
    inner = replace(kept, photo=np.array([place[int(p)] for p in kept.photo]))
    corners = triangulate(adjusted.lens, adjusted.poses, inner, len(stage1.corners.marker_ids))
    lengths = edge_lengths(corners[np.isfinite(corners).all(axis=(1, 2))])
    figures = spread(lengths)
    return EdgeLength(expected=expected, mean=figures.mean, std=figures.std, n=figures.n)


def _coverage(view: View, mirrored: bool, corners: Floats, chosen: Placement, cube: Cube) -> float:
    """Share of the cube's pixels within the hull of the markers' corners that have a point."""
    import cv2

    pixels = view.project(corners.reshape(-1, 3))
    if mirrored:
        pixels[:, 0] = cube.cols - 1 - pixels[:, 0]
    hull = cv2.convexHull(pixels.astype(np.float32)).astype(np.int32)
    inside = np.zeros((cube.rows, cube.cols), np.uint8)
    cv2.fillConvexPoly(inside, hull, 1)
    placed = np.zeros_like(inside)
    placed[chosen.pixels[:, 0], chosen.pixels[:, 1]] = 1
    return float((inside & placed).sum() / max(int(inside.sum()), 1))


def _as_seen(placement: Placement, mirrored: bool, cols: int) -> Floats:
    """Pixels (S, 2) x, y as the camera saw them."""
    pixels = placement.pixels[:, ::-1].astype(float)
    if mirrored:
        pixels[:, 0] = cols - 1 - pixels[:, 0]
    return pixels


def _parallax(apart: NDArray[np.float32]) -> Parallax:
    """How far apart the two methods put the specimen's pixels."""
    known = apart[np.isfinite(apart)]
    if not known.size:
        return Parallax(median=0.0, maximum=0.0)
    return Parallax(median=float(np.median(known)), maximum=float(known.max()))


def _sigma(points: CloudPoints) -> SigmaFigures:
    on_it = (points.flags & Flag.SPECIMEN) > 0
    sigma = points.sigma_mm[on_it] if on_it.any() else points.sigma_mm
    return SigmaFigures(median=float(np.median(sigma)), p95=float(np.percentile(sigma, 95)))


def _camera(camera: CubeCamera, found: CubeMarkers, cube: Cube) -> CubeCameraFigures:
    pose: Pose = camera.view.cam_from_world
    x_axis = pose.R[:, 0]
    return CubeCameraFigures(
        focal_px=camera.focal_px,
        focal_relative_sd=camera.focal_sd,
        distance_mm=float(pose.centre[2]),
        reprojection_rms_px=camera.rms_px,
        roll_deg=float(np.degrees(np.arctan2(-x_axis[1], x_axis[0]))),
        mirrored=found.mirrored,
        markers_found_in=found.where,
        model=camera.model.scanned,
        pixel_aspect=camera.view.intrinsics.aspect,
    )

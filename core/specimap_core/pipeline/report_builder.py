"""Build the report of a run from the results of its stages."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core import __version__
from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.cloud import CloudPoints, Flag
from specimap_core.fiducials.layout import edge_lengths
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.notices import Notice
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.pipeline.corners import cube_corners, photo_corners
from specimap_core.pipeline.run_warnings import run_warnings
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.register.accuracy import spread
from specimap_core.register.cube_markers import unmirrored
from specimap_core.register.registration import Registered
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


@dataclass(frozen=True)
class RunRecord:
    """What the report states of the run itself: its ``settings``, ``hashes`` of its inputs, ``seconds`` of the stages
    before, those ``reused``, and ``warnings`` about the inputs."""

    settings: PipelineSettings
    hashes: Mapping[str, str]
    seconds: Mapping[str, float]
    reused: Sequence[str]
    warnings: Sequence[Notice]


def build_report(stage1: Stage1, adjusted: Adjusted, registered: Registered, run: RunRecord) -> Report:
    """The report, without the warnings that its own figures call for and those of the written cloud."""
    settings, markers, camera = run.settings, registered.markers, registered.camera.camera
    own, inliers = registered.figures[registered.method], registered.homography.inliers
    on_specimen = _on_specimen(registered.points)
    lens = camera.view.intrinsics
    return Report(
        specimap_version=__version__,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        method=registered.method,
        backend=settings.reconstruct.backend,
        adjustment=settings.adjust.form,
        marker_ids=list(adjusted.marker_ids),
        marker_ids_in_cube=list(markers.marker_ids),
        corner_2d_mm=own.corner_2d_mm,
        corner_3d_mm=own.corner_3d_mm,
        leave_one_marker_out_mm=own.leave_one_marker_out_mm,
        methods=dict(registered.figures),
        edge_length_mm=triangulated_edges(stage1, adjusted, settings.adjust.edge_mm),
        corner_sigma_mm=float(np.median(adjusted.sigma_corner_mm)),
        reprojection_px=Reprojection(before=adjusted.rms_before_px, after=adjusted.rms_after_px),
        photos=Photos(
            given=len(stage1.names) + len(stage1.refused),
            used=[stage1.names[p] for p in stage1.reconstruction.photos],
            refused=[Refused(**asdict(r)) for r in (*stage1.refused, *stage1.reconstruction.refused)],
        ),
        inliers=Inliers(
            n=int(inliers.sum()),
            of=len(inliers),
            threshold_px=settings.register.ransac_px,
            threshold_mm=settings.register.ransac_px * settings.render.r_reg_mm,
        ),
        coverage=Coverage(
            between_markers=_coverage(registered, adjusted.corners),
            points=len(registered.points),
            specimen_points=int(on_specimen.sum()),
        ),
        parallax_removed_mm=_parallax(registered.parallax_mm[on_specimen]),
        sigma_mm=_sigma(registered.points),
        cube_camera=_camera(registered),
        photo_focal_px=adjusted.lens.focal_px,
        seconds=dict(run.seconds),
        reused_stages=list(run.reused),
        warnings=[*run.warnings, *run_warnings(stage1, adjusted, markers), *registered.warnings],
        settings=settings.as_dict(),
        inputs=dict(run.hashes),
        photo_corners=photo_corners(stage1, adjusted),
        cube_corners=cube_corners(markers, adjusted, camera.view, lens.height, lens.width),
    )


def triangulated_edges(stage1: Stage1, adjusted: Adjusted, expected: float) -> EdgeLength:
    """Edges of corners triangulated one by one: rigid squares would only repeat the known edge."""
    seen = stage1.corners.seen
    place = {photo: k for k, photo in enumerate(stage1.reconstruction.photos)}
    kept = seen.of(np.isin(seen.photo, stage1.reconstruction.photos))
    inner = replace(kept, photo=np.array([place[int(p)] for p in kept.photo]))
    corners = triangulate(adjusted.lens, adjusted.poses, inner, len(stage1.corners.marker_ids))
    lengths = edge_lengths(corners[np.isfinite(corners).all(axis=(1, 2))])
    figures = spread(lengths)
    return EdgeLength(expected=expected, mean=figures.mean, std=figures.std, n=figures.n)


def _on_specimen(points: CloudPoints) -> NDArray[np.bool_]:
    return np.asarray((points.flags & Flag.SPECIMEN) > 0)


def _coverage(registered: Registered, corners: Floats) -> float:
    """Share of the cube's pixels within the hull of the markers' ``corners`` (Q, 4, 3) mm that have a point."""
    view = registered.camera.camera.view
    lens = view.intrinsics
    pixels = unmirrored(view.project(corners.reshape(-1, 3)), registered.markers.mirrored, lens.width)
    hull = cv2.convexHull(pixels.astype(np.float32)).astype(np.int32)
    inside = np.zeros((lens.height, lens.width), np.uint8)
    cv2.fillConvexPoly(inside, hull, 1)
    covered = np.zeros_like(inside)
    covered[registered.points.hsi_pixel[:, 0], registered.points.hsi_pixel[:, 1]] = 1
    return float((inside & covered).sum() / max(int(inside.sum()), 1))


def _parallax(parallax_mm: NDArray[np.float32]) -> Parallax:
    """How far apart the two methods put the specimen's pixels."""
    known = parallax_mm[np.isfinite(parallax_mm)]
    if not known.size:
        return Parallax(median=0.0, maximum=0.0)
    return Parallax(median=float(np.median(known)), maximum=float(known.max()))


def _sigma(points: CloudPoints) -> SigmaFigures:
    """Of the specimen's points, of all where none is known as such."""
    on_specimen = _on_specimen(points)
    sigma = points.sigma_mm[on_specimen] if on_specimen.any() else points.sigma_mm
    return SigmaFigures(median=float(np.median(sigma)), p95=float(np.percentile(sigma, 95)))


def _camera(registered: Registered) -> CubeCameraFigures:
    camera, markers = registered.camera.camera, registered.markers
    pose = camera.view.cam_from_world
    x_axis = pose.R[:, 0]
    return CubeCameraFigures(
        focal_px=camera.focal_px,
        focal_relative_sd=camera.focal_sd,
        distance_mm=float(pose.centre[2]),
        reprojection_rms_px=camera.rms_px,
        roll_deg=float(np.degrees(np.arctan2(-x_axis[1], x_axis[0]))),
        mirrored=markers.mirrored,
        markers_found_in=markers.where,
        model=camera.model.scanned,
        pixel_aspect=camera.view.intrinsics.aspect,
    )

"""Marker corners as measured and their reprojection residuals, for the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.bundle_adjust.solver import MarkerScene
from specimap_core.geometry.cameras import View
from specimap_core.pipeline.artefacts import Stage1
from specimap_core.register.cube_markers import CubeMarkers, unmirrored
from specimap_core.report.model import CubeCorners, PhotoCorners

RESIDUAL_DIGITS = 2
"""A hundredth of a pixel: finer than any corner is measured."""
CORNER_DIGITS = 1
"""For drawing; forty photos of a board with all digits would make report.json half as large again."""


def photo_corners(stage1: Stage1, adjusted: Adjusted) -> list[PhotoCorners]:
    """Corners and residuals after stage 2 in each used photo, in the photos' order."""
    seen, photos = stage1.corners.seen, stage1.reconstruction.photos
    # Markers that one photo alone shows have no adjusted corners.
    row = {i: k for k, i in enumerate(adjusted.marker_ids)}
    ids = np.array([row.get(i, -1) for i in stage1.corners.marker_ids], int)
    place = {photo: k for k, photo in enumerate(photos)}
    kept = seen.of(np.isin(seen.photo, photos) & (ids[seen.marker] >= 0))
    kept = replace(kept, photo=np.array([place[int(p)] for p in kept.photo], int), marker=ids[kept.marker])
    residuals = MarkerScene(adjusted.lens, adjusted.poses, adjusted.corners, None).residuals(kept)
    return [
        PhotoCorners(
            name=stage1.names[photo],
            width_px=adjusted.lens.width,
            height_px=adjusted.lens.height,
            marker_ids=[adjusted.marker_ids[m] for m in kept.marker[kept.photo == k]],
            corners_px=_rows(kept.corners_px[kept.photo == k], CORNER_DIGITS),
            residuals_px=_rows(residuals[kept.photo == k], RESIDUAL_DIGITS),
        )
        for k, photo in enumerate(photos)
    ]


def cube_corners(found: CubeMarkers, adjusted: Adjusted, view: View, rows: int, cols: int) -> CubeCorners:
    """Corners in the cube as it is stored, and residuals of its solved camera."""
    placed = adjusted.corners[[adjusted.marker_ids.index(i) for i in found.marker_ids]]
    projected = unmirrored(view.project(placed), found.mirrored, cols)
    return CubeCorners(
        rows=rows,
        cols=cols,
        marker_ids=list(found.marker_ids),
        corners_px=_rows(found.corners_px, CORNER_DIGITS),
        residuals_px=_rows(projected - found.corners_px, RESIDUAL_DIGITS),
    )


def _rows(values: Floats, digits: int) -> list[list[float]]:
    """(M, 4, 2) as M rows of eight rounded numbers; minus zero becomes zero."""
    rounded = np.round(values.reshape(len(values), 8), digits) + 0.0
    found: list[list[float]] = rounded.tolist()
    return found

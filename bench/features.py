"""SIFT and ALIKED where they matter: phantoms of little texture and much gloss whose markers few photos show."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from bench.service.sheet import NONE, Sheet
from specimap_core.arrays import Floats
from specimap_core.errors import SpecimapError
from specimap_core.geometry.cameras import Pose, fit_similarity
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photos
from specimap_core.reconstruct.backend import CornersInPhotos, ReconstructSettings, corners_in_photos, detect_in_photos
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.reconstruct.features.choice import aliked_missing
from specimap_core.reconstruct.poses import Posed, pose_photos
from specimap_core.surface.fusion import Mesh, fuse, vertex_normals
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.settings import SurfaceSettings
from specimap_core.truth.truth_file import Truth
from specimap_validation.phantom import PhantomSettings, write_phantom
from specimap_validation.phantom.views import photo_views

PHOTOS = 16
WITH_MARKERS = 4
WORKERS = 2
CASES = (
    (1.0, 0.15, True),
    (0.5, 0.15, True),
    (0.25, 0.15, True),
    (0.1, 0.15, True),
    (0.25, 0.4, True),
    (0.25, 0.8, True),
    (0.25, 0.8, False),
    (0.1, 0.8, False),
    (0.0, 0.15, False),
    (0.0, 0.8, False),
)
"""Texture contrast, gloss, and whether the cards show, unread, in the photos that features have to locate; where they
do not, the tissue and the outline of its shadow are all that these photos share with the others."""
VOXEL_MM = 0.3
SPECIMEN_MIDDLE = np.array([0.0, 0.0, 6.0])
KINDS: tuple[Literal["sift", "aliked"], ...] = ("sift", "aliked")


@dataclass(frozen=True)
class Outcome:
    """``photos`` posed; median and largest error of the poses of those without markers, in degrees and in mm by which
    the middle of the specimen shifts across the line of sight; median error of the surface's height, mm; seconds, and
    those of all threads together."""

    photos: int
    deg: float
    mm: float
    worst_mm: float
    surface_mm: float
    seconds: float
    cpu_s: float


def bench_features(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Each case by each kind of features; the fastest of ``repeats`` gives the seconds."""
    kinds = KINDS[:1] if aliked_missing() else KINDS
    rows: list[list[object]] = []
    for texture, gloss, cards in CASES:
        folder = work / f"features_{texture}_{gloss}_{cards}"
        settings = PhantomSettings(
            photos=PHOTOS, texture_contrast=texture, gloss=gloss, bands=2, cube_rows=64, cube_cols=64
        )
        near = _neighbours(settings)
        if not cards:
            settings = replace(settings, bare_photos=tuple(p for p in range(PHOTOS) if p not in near))
        truth = write_phantom(settings, folder)
        photos, _ = read_photos(photo_paths(folder / "rgb"), AcquisitionSettings())
        corners = _read_in(near, photos)
        for kind in kinds:
            runs = [_run(photos, corners, truth, kind) for _ in range(repeats)]
            found = [r for r in runs if isinstance(r, Outcome)]
            rows.append(
                [
                    f"{texture:g}",
                    f"{gloss:g}",
                    "shown" if cards else "none",
                    kind,
                    vars(min(found, key=lambda r: r.seconds)) if found else str(runs[0]),
                ]
            )
    figures: dict[str, object] = {"rows": rows}
    sheet_features(figures).show(console)
    if len(kinds) < len(KINDS):
        console.print("ALIKED is not installed: SIFT alone was measured.")
    return figures


def sheet_features(figures: dict[str, Any]) -> Sheet:
    """The table of kept figures."""
    sheet = Sheet(
        f"{PHOTOS} photos, markers read in {WITH_MARKERS} neighbours only; the rest by features",
        (
            "texture",
            "gloss",
            "cards",
            "features",
            "photos posed",
            "pose, degrees",
            "pose, mm",
            "worst, mm",
            "surface, mm",
            "seconds",
            "CPU s",
        ),
    )
    for *case, found in figures["rows"]:
        if isinstance(found, str):
            sheet.rows.append([*case, found, *[NONE] * 6])
            continue
        best = Outcome(**found)
        sheet.rows.append(
            [
                *case,
                f"{best.photos} of {PHOTOS}",
                f"{best.deg:.2f}",
                f"{best.mm:.3f}",
                f"{best.worst_mm:.2f}",
                f"{best.surface_mm:.3f}",
                f"{best.seconds:.1f}",
                f"{best.cpu_s:.1f}",
            ]
        )
    return sheet


def _neighbours(settings: PhantomSettings) -> list[int]:
    """The first photo and those next to it."""
    centres = np.stack([v.cam_from_world.centre for v in photo_views(settings)])
    return [int(p) for p in np.argsort(np.linalg.norm(centres - centres[0], axis=1))[:WITH_MARKERS]]


def _read_in(near: list[int], photos: list[Photo]) -> CornersInPhotos:
    """The corners of the photos ``near``; elsewhere the markers count as not seen."""
    detections = detect_in_photos(photos, "DICT_4X4_50", workers=WORKERS, progress=lambda share: None)
    corners = corners_in_photos(photos, detections, "DICT_4X4_50")
    return CornersInPhotos(corners.seen.of(np.isin(corners.seen.photo, near)), corners.marker_ids)


def _run(photos: list[Photo], corners: CornersInPhotos, truth: Truth, kind: Literal["sift", "aliked"]) -> Outcome | str:
    start, cpu = time.perf_counter(), time.process_time()
    try:
        posed = pose_photos(photos, corners, ReconstructSettings(features=kind), workers=WORKERS)
    except SpecimapError as error:
        return error.code
    seconds, cpu_s = time.perf_counter() - start, time.process_time() - cpu
    _, R, t = fit_similarity(posed.corners.reshape(-1, 3), truth.marker_corners.reshape(-1, 3))
    to_truth = Pose(R, t)
    back = to_truth.inverse()
    deg, mm = [], []
    for photo, pose in zip(posed.photos, posed.poses, strict=True):
        if photo in corners.seen.photo:
            continue
        found, true = pose @ back, truth.views[photo].cam_from_world
        deg.append(np.degrees(np.arccos(np.clip((np.trace(found.R.T @ true.R) - 1) / 2, -1, 1))))
        mm.append(np.linalg.norm((found.apply(SPECIMEN_MIDDLE) - true.apply(SPECIMEN_MIDDLE))[:2]))
    if not mm:
        return "none located"
    surface = _surface_mm(photos, posed, to_truth, truth)
    return Outcome(
        len(posed.photos), float(np.median(deg)), float(np.median(mm)), float(np.max(mm)), surface, seconds, cpu_s
    )


def _surface_mm(photos: list[Photo], posed: Posed, to_truth: Pose, truth: Truth) -> float:
    """Median difference of the surfaces' heights over the specimen; not a number where nothing was fused."""
    volume = volume_over(posed.corners, posed.poses)
    images = [photos[p].image for p in posed.photos]
    maps = dense_depth(images, posed.lens, posed.poses, volume, DepthSettings(), workers=WORKERS)
    try:
        mesh = fuse(maps, posed.poses, VOXEL_MM, SurfaceSettings())
    except SpecimapError:
        return float("nan")
    low, high = truth.vertices[:, :2].min(0), truth.vertices[:, :2].max(0)
    x, y = np.meshgrid(np.arange(low[0], high[0], 0.5), np.arange(low[1], high[1], 0.5))
    found = _heights(_mesh(to_truth.apply(mesh.vertices.astype(float)), mesh.triangles), x.ravel(), y.ravel())
    true = _heights(_mesh(truth.vertices, truth.triangles), x.ravel(), y.ravel())
    return float(np.nanmedian(np.abs(found - true)))


def _mesh(vertices: Floats, triangles: np.ndarray[tuple[int, ...], np.dtype[np.int32]]) -> Mesh:
    single = vertices.astype(np.float32)
    return Mesh(single, triangles, vertex_normals(single, triangles), np.zeros(single.shape, np.uint8))


def _heights(mesh: Mesh, x: Floats, y: Floats) -> Floats:
    above = np.stack([x, y, np.full(len(x), 100.0)], -1)
    return RayCaster(mesh).cast(above, np.tile([0.0, 0.0, -1.0], (len(x), 1))).xyz[:, 2].astype(float)

"""The first three stages: load what an earlier run left, else call the stage, save, time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import adjust
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.native import preload
from specimap_core.notices import Notice
from specimap_core.photos.contact_sheet import contact_sheet
from specimap_core.photos.reading import Photo, read_photos, stated_focal_px
from specimap_core.pipeline.artefact_store import Store
from specimap_core.pipeline.artefacts import (
    Stage1,
    Stage2,
    load_grids,
    load_stage1,
    save_grids,
    save_stage1,
    save_stage2,
)
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.scale_check import check_scale
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backend import ReconstructionBackend, corners_in_photos, detect_in_photos
from specimap_core.reconstruct.backends.environment import UNCONFIGURED, BackendSettings
from specimap_core.reconstruct.backends.requirements import check_required
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.reconstruct.focal_breathing import correct_focal_breathing
from specimap_core.reconstruct.photo_resolution import at_own_resolution
from specimap_core.render.orthographic import Grid, extent_of, render_grid
from specimap_core.surface.fusion import fuse
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.refinement import Refined, pixel_footprint_mm, refine_mesh
from specimap_core.surface.regions import worth_refining
from specimap_core.surface.uncertainty import mesh_sigma

VOXEL_PIXELS = 1.4
"""Edge of a fusion voxel in matched pixels on the specimen: finer ones hold noise, coarser ones lose bumps."""
GRID_MARGIN_MM = 4.0


def backend_named(name: str, backends: BackendSettings) -> ReconstructionBackend:
    """The backend of that name; settings have been checked."""
    if name == "mast3r":
        from specimap_core.reconstruct.backends.mast3r.backend import Mast3rBackend

        return Mast3rBackend(backends.mast3r)
    if name == "da3":
        from specimap_core.reconstruct.backends.da3.backend import Da3Backend

        return Da3Backend(backends.da3)
    from specimap_core.reconstruct.backends.colmap import ColmapBackend

    return ColmapBackend()


def reconstruct_stage(
    paths: list[Path],
    settings: PipelineSettings,
    store: Store,
    key: str,
    clock: Clock,
    workers: int,
    *,
    with_depth: bool = True,
    backends: BackendSettings = UNCONFIGURED,
) -> Stage1:
    """Stage 1, or what an earlier run left of it, then ``with_depth`` maps or without."""
    with clock.stage("reconstruct") as progress:
        found = load_stage1(store, key, with_depth=with_depth)
        if found is not None:
            clock.reused.append("reconstruct")
            return found
        check_required(settings.reconstruct, backends)
        backend = backend_named(settings.reconstruct.backend, backends)
        preload()
        photos, refused = read_photos(
            paths, settings.acquisition, workers=workers, progress=lambda s: progress(0.08 * s)
        )
        detections = detect_in_photos(
            photos, settings.reconstruct.dictionary, workers=workers, progress=lambda s: progress(0.08 + 0.12 * s)
        )
        photos, detections = at_own_resolution(photos, detections, workers=workers)
        corners = corners_in_photos(photos, detections, settings.reconstruct.dictionary)
        photos, corners, zooms = correct_focal_breathing(
            photos, corners, edge_mm=settings.adjust.edge_mm, focal_px=stated_focal_px(photos), workers=workers
        )
        if corners.solution is not None:
            scene = corners.solution.scene
            check_scale(scene.poses, scene.corners, settings, _subject_mm(photos))
        reconstruction = backend.reconstruct(
            photos,
            corners,
            settings.for_stage1(),
            workers=workers,
            progress=lambda s: progress(0.2 + 0.8 * s),
        )
        if (zooms != 1).any():
            warning = Notice(
                "focal_breathing",
                f"The photos' focal lengths differ by {100 * zooms.std():.1f} % "
                + ("(standard deviation); each photo was brought to the one they share."),
            )
            reconstruction = replace(reconstruction, warnings=(*reconstruction.warnings, warning))
        stage = Stage1(
            reconstruction,
            corners,
            tuple(p.name for p in photos),
            tuple(refused),
            _subject_mm(photos),
            tuple(photos[p].grey for p in reconstruction.photos),
            contact_sheet([photos[p].image for p in reconstruction.photos]),
        )
        save_stage1(store, key, stage)
        # As stored: depth is rounded there, and a run that goes on later must come out the same.
        return load_stage1(store, key, with_depth=True) or stage


def _subject_mm(photos: list[Photo]) -> float | None:
    stated = [p.subject_mm for p in photos if p.subject_mm]
    return float(np.median(stated)) if stated else None


def adjust_stage(
    stage1: Stage1,
    settings: PipelineSettings,
    store: Store,
    key: str,
    clock: Clock,
    workers: int,
    kept: Stage2 | None = None,
) -> Stage2:
    """Stage 2, or ``kept``, what an earlier run left of it."""
    with clock.stage("adjust") as progress:
        if kept is not None:
            clock.reused.append("adjust")
            return kept
        r = stage1.reconstruction
        seen = stage1.corners.seen
        place = {photo: k for k, photo in enumerate(r.photos)}
        posed = seen.of(np.isin(seen.photo, r.photos))
        posed = replace(posed, photo=np.array([place[int(p)] for p in posed.photo]))
        adjusted = adjust(r.lens, r.poses, posed, stage1.corners.marker_ids, settings.adjust)
        check_scale(adjusted.poses, adjusted.corners, settings, stage1.subject_mm)
        maps = tuple(replace(m, depth=m.depth * np.float32(adjusted.scale)) for m in r.maps)
        refined = mesh_of(
            maps,
            list(stage1.greys),
            adjusted.lens,
            adjusted.poses,
            adjusted.corners,
            settings,
            workers=workers,
            progress=lambda s: progress(0.05 + 0.9 * s),
        )
        sigma = mesh_sigma(refined, maps, adjusted.poses, workers=workers)
        stage = Stage2(adjusted, refined.mesh, sigma.astype(float))
        save_stage2(store, key, stage)
        return stage


def mesh_of(
    maps: tuple[DepthMap, ...],
    greys: list[NDArray[np.uint8]],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    corners: Floats,
    settings: PipelineSettings,
    *,
    workers: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Refined:
    """Depth maps in mm to a mesh refined on the photos' ``greys``; all in the frame of ``poses`` and ``corners``."""
    pixel_mm = pixel_footprint_mm(lens, poses, volume_over(corners, poses).centre)
    shrinkage = settings.reconstruct.depth.shrinkage(lens)
    voxel_mm = settings.surface.voxel_mm or VOXEL_PIXELS * pixel_mm / shrinkage
    fused = fuse(list(maps), poses, voxel_mm, settings.surface, progress=lambda s: progress(0.4 * s))
    return refine_mesh(
        fused,
        greys,
        lens,
        poses,
        voxel_mm,
        settings.refine,
        workers=workers,
        worth=worth_refining(fused.vertices, corners),
        progress=lambda s: progress(0.4 + 0.6 * s),
    )


def render_stage(
    stage2: Stage2, caster: RayCaster, settings: PipelineSettings, store: Store, key: str, clock: Clock
) -> tuple[Grid, Grid]:
    """Stage 3, or what an earlier run left of it: the coarse and the fine grid."""
    with clock.stage("render") as progress:
        found = load_grids(store, key, stage2.mesh)
        if found is not None:
            clock.reused.append("render")
            return found
        low, high = extent_of(stage2.adjusted.corners, GRID_MARGIN_MM)
        coarse = render_grid(caster, low, high, settings.render.r_reg_mm)
        progress(0.3)
        fine = render_grid(caster, low, high, settings.render.r_pc_mm)
        save_grids(store, key, (coarse, fine), stage2.mesh)
        return coarse, fine

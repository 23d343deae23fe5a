"""The ``da3`` backend: poses from markers and features, depth by Depth Anything 3, brought to scale view by view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from specimap_core.arrays import Array, Bytes, Floats, Singles
from specimap_core.errors import BackendFailedError, DepthNotFoundError
from specimap_core.geometry.cameras import View
from specimap_core.geometry.depth_map import DepthMap, cropped_map
from specimap_core.notices import Notice
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.backend import (
    CornersInPhotos,
    Progress,
    Reconstruction,
    ReconstructSettings,
    sparse_points,
)
from specimap_core.reconstruct.backends.da3.known_depths import placed_features
from specimap_core.reconstruct.backends.da3.prepare import conditioning, plan_preparation, windows
from specimap_core.reconstruct.backends.da3.residual_field import correct_residuals
from specimap_core.reconstruct.backends.da3.settings import NAME, PREFIX, Da3Settings
from specimap_core.reconstruct.backends.depth_alignment import LARGEST_SCATTER, align, depths_at, on_markers
from specimap_core.reconstruct.backends.network_warnings import backend_run, depth_unaligned
from specimap_core.reconstruct.dense.cross_check import confirmed, nearest_photos, share_confirmed
from specimap_core.reconstruct.dense.volume import Volume, inside_volume, volume_over
from specimap_core.reconstruct.poses import pose_photos
from specimap_core.sandbox.process import Answer, run_child

CHILD = Path(__file__).with_name("child.py")
STEEPEST = 6.0
"""Depth that changes more than this many times the pixel's own width from a pixel to the next is an edge, where a
network draws false surface between front and back; true surface so steep, 80 degrees, shows better to other photos."""
CONFIRMING = 4
TOLERANCE = 0.01
"""Share of the depth by which views may differ and still confirm each other; more where they scatter more."""

LICENCE = Notice(
    "licence_apache", "Depth Anything 3's code and its SMALL and BASE weights are under the Apache licence 2.0."
)


class Da3Backend:
    """Cameras as the default backend's; the network gives depth alone."""

    name = NAME

    def __init__(self, settings: Da3Settings, child: Path = CHILD) -> None:
        """``child``: the script that holds the network."""
        self._settings = settings
        self._child = child

    def reconstruct(
        self,
        photos: list[Photo],
        corners: CornersInPhotos,
        settings: ReconstructSettings,
        *,
        workers: int,
        progress: Progress,
    ) -> Reconstruction:
        """See :class:`specimap_core.reconstruct.backend.ReconstructionBackend`.

        Raises:
            BackendUnavailableError: weights, code or interpreter are missing or do not fit.
            BackendFailedError: the network's process crashed or ran out of memory.
            DepthNotFoundError: no view's depth fits what is known in millimetres.
        """
        own = self._settings
        weights, code = own.find_weights(), own.code_path()
        posed = pose_photos(photos, corners, settings, workers=workers, progress=lambda share: progress(0.1 * share))
        progress(0.1)
        volume = volume_over(posed.corners, posed.poses)
        shown = [photos[p] for p in posed.photos]
        preparation = plan_preparation(posed.lens, own.size_px)
        images = np.stack([preparation.apply(photo.image) for photo in shown])
        together = windows(posed.poses, volume.centre, own.batch)
        given = np.zeros((len(images), 4, 4))
        for window in together:
            given[window] = conditioning([posed.poses[k] for k in window])
        answer = self._infer(
            {"weights": str(weights.path), "device": own.device, "workers": workers, "windows": together},
            {"images": images, "K": np.repeat(preparation.intrinsics.matrix[None], len(images), 0), "poses": given},
            own,
            code,
            lambda share: progress(0.1 + 0.75 * share),
        )
        views, network = [View(preparation.intrinsics, p) for p in posed.poses], answer.arrays["depth"]
        progress(0.85)
        features = placed_features(
            shown,
            posed.lens,
            posed.poses,
            volume.centre,
            workers=workers,
            progress=lambda share: progress(0.85 + 0.1 * share),
        )
        metric: list[Metric | None] = []
        for photo, places, view, depth in zip(posed.photos, features, views, network, strict=True):
            points = np.concatenate([on_markers(posed.corners, corners.seen, photo), places])
            metric.append(in_millimetres(points, view, depth, settings.seed))
        progress(0.95)
        maps = maps_of(images, views, metric, volume, workers)
        warnings = (
            LICENCE,
            backend_run(f"Depth Anything 3, {answer.facts['variant']},", answer.facts, weights),
            *_unaligned(shown, metric),
        )
        progress(1.0)
        return Reconstruction(
            posed.photos,
            posed.lens,
            posed.poses,
            tuple(maps),
            sparse_points(maps, posed.poses),
            posed.refused,
            (*posed.warnings, *warnings),
        )

    def _infer(
        self,
        request: dict[str, object],
        arrays: dict[str, Array],
        own: Da3Settings,
        code: list[Path],
        progress: Progress,
    ) -> Answer:
        try:
            return run_child(
                self._child,
                request,
                arrays,
                name=NAME,
                steps={"depth": 1.0},
                progress=progress,
                python=own.python,
                extra_path=code,
            )
        except BackendFailedError as error:
            if error.details.get("reason") != "out_of_memory":
                raise
            raise BackendFailedError(
                error.message,
                advice=f"Lower {PREFIX}BATCH, now {own.batch} photos at once, or {PREFIX}SIZE_PX, now {own.size_px}.",
                **error.details,
            ) from error


@dataclass(frozen=True)
class Metric:
    """``depth`` (h, w) mm of one view; ``scatter``: one standard deviation about known places, as a share of it."""

    depth: Singles
    scatter: float


def in_millimetres(points: Floats, view: View, network: Singles, seed: int) -> Metric | None:
    """The network's depth (h, w) brought to what is known of ``points`` (N, 3) mm; None where it does not fit them."""
    at, found, true = depths_at(points, view, network)
    fit = align(found, true, seed=seed)
    if fit is None:
        return None
    depth, scatter = correct_residuals(fit.apply(network), at, true)
    return Metric(depth, scatter) if np.isfinite(scatter) else None


def _unaligned(photos: list[Photo], metric: list[Metric | None]) -> list[Notice]:
    """The warning about views without a scale.

    Raises:
        DepthNotFoundError: none has one.
    """
    left = [photo.name for photo, found in zip(photos, metric, strict=True) if found is None]
    if len(left) == len(photos):
        raise DepthNotFoundError(
            "The network's depth fits the markers and features of no photo.",
            advice="Use the default backend, or weights that fit the code of Depth Anything 3.",
            photos=left,
        )
    return depth_unaligned("Depth Anything 3", "markers and features", left, len(photos))


def smooth_surface(depth: Singles, view: View) -> Singles:
    """Depth (H, W) mm without its edges: see :data:`STEEPEST`."""
    known = depth > 0
    low = minimum_filter(np.where(known, depth, np.inf), 3, mode="nearest")
    high = maximum_filter(np.where(known, depth, -np.inf), 3, mode="nearest")
    # From one side of three pixels to the other are two steps.
    steepest = 2 * STEEPEST * depth / view.intrinsics.focal_px
    return np.where(known & (high - low < steepest), depth, 0).astype(np.float32)


def maps_of(
    images: Bytes, views: list[View], metric: list[Metric | None], volume: Volume, workers: int
) -> list[DepthMap]:
    """Depths of the views, cut to the volume, without edges and without what other views contradict.

    The confidence tells how well a view fits what is known, and which share of the other views confirms a depth.
    """
    used = [k for k, found in enumerate(metric) if found is not None]
    known = [found for found in metric if found is not None]
    if not used:
        return []
    chosen = [views[k] for k in used]
    depths = []
    for view, found in zip(chosen, known, strict=True):
        pose = view.cam_from_world
        depths.append(smooth_surface(inside_volume(found.depth, view.intrinsics, pose.R, pose, volume), view))
    tolerance = max(TOLERANCE, 3 * float(np.median([found.scatter for found in known])))
    others = nearest_photos([v.cam_from_world for v in chosen], volume.centre, CONFIRMING)
    checked = confirmed(depths, chosen, others, tolerance, workers=workers)
    maps = []
    for k, found, depth, (seen, agreed) in zip(used, known, depths, checked, strict=True):
        sure = np.where((seen >= 2) & (agreed == 0), np.float32(0), depth)
        trust = max(0.1, 1 - found.scatter / LARGEST_SCATTER) * share_confirmed(seen, agreed)
        confidence = np.rint(255 * trust).astype(np.uint8)
        cropped = cropped_map(k, np.eye(3), views[k].intrinsics, sure, images[k], confidence)
        if cropped is not None:
            maps.append(cropped)
    return maps

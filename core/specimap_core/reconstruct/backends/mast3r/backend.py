"""The ``mast3r`` backend: MASt3R-SfM's cameras and depth, brought into the marker frame.

The published way to reconstruct. Code and weights are the user's, for non-commercial use only; they run in a process
of their own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap_core.errors import TooFewPhotosError
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.notices import Notice
from specimap_core.photos.reading import Photo, Refusal
from specimap_core.reconstruct.backend import (
    CornersInPhotos,
    Progress,
    Reconstruction,
    ReconstructSettings,
    sparse_points,
)
from specimap_core.reconstruct.backends.marker_alignment import align_to_markers
from specimap_core.reconstruct.backends.mast3r.images import Preparation, plan_preparation
from specimap_core.reconstruct.backends.mast3r.maps import depth_maps
from specimap_core.reconstruct.backends.mast3r.metric import Predicted, as_predicted, hold_to_markers, network_lens
from specimap_core.reconstruct.backends.mast3r.settings import (
    NAME,
    Mast3rSettings,
    check_home,
    weights_of,
)
from specimap_core.reconstruct.backends.network_warnings import backend_run, depth_unaligned
from specimap_core.sandbox.process import Answer, run_child

CHILD = Path(__file__).with_name("child.py")
STEPS = {"load": 3.0, "pairs": 70.0, "views": 5.0, "coarse": 9.0, "fine": 11.0, "depth": 2.0}
"""The child's steps and about how the time falls on them, on a GPU with 20 photos."""
LEAST_PHOTOS = 3
LICENCE = Notice(
    "licence_non_commercial",
    "MASt3R's code and weights are CC BY-NC-SA 4.0: non-commercial use only.",
)


class Mast3rBackend:
    """MASt3R-SfM from the checkout and with the weights that its settings name."""

    name = NAME

    def __init__(self, settings: Mast3rSettings, script: Path | None = None) -> None:
        self._settings = settings
        self._script = script

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
            BackendUnavailableError: checkout, weights or a module is missing, or the weights are not MASt3R's.
            BackendFailedError: it crashed or ran out of memory.
            PhotosNotConnectedError, DepthNotFoundError, MarkerGeometryError, TooFewPhotosError: no solution.
        """
        chosen = self._settings
        home, weights = check_home(chosen.home), weights_of(chosen)
        plan = plan_preparation(photos[0].size, chosen.size_px)
        images = np.stack([plan.apply(p.image) for p in photos])
        request = {
            "home": home,
            "weights": weights.path,
            "device": chosen.device,
            "subsample": chosen.subsample,
            "schedule": chosen.schedule,
            "pairs": chosen.pairs(len(photos)),
            "seed": settings.seed,
            "threads": workers,
            "names": [p.name for p in photos],
        }
        answer = run_child(
            self._script or CHILD,
            request,
            {"images": images},
            name=NAME,
            steps=STEPS,
            python=chosen.python,
            scratch=chosen.cache,
            progress=lambda share: progress(0.95 * share),
        )
        lens, poses = cameras_of(answer, plan)
        predicted = predicted_by(answer)
        placed = align_to_markers(lens, poses, corners, [p.name for p in photos], settings.edge_mm)
        metric = (
            hold_to_markers(
                lens, placed, corners, predicted, plan, chosen.confidence, edge_mm=settings.edge_mm, seed=settings.seed
            )
            if settings.hold_to_markers
            else as_predicted(lens, placed, predicted)
        )
        used = tuple(p for p in range(len(photos)) if p not in placed.foreign)
        if len(used) < LEAST_PHOTOS:
            raise TooFewPhotosError(
                f"Only {len(used)} photos could be posed.", advice="Take more photos, all around the specimen."
            )
        refused = tuple(
            Refusal(photos[p].name, "photo_foreign", f"MASt3R puts its markers {px:.0f} px from where the others do.")
            for p, px in placed.foreign.items()
        )
        kept = tuple(metric.poses[p] for p in used)
        seen_lens = network_lens(metric.lens, plan)
        maps = depth_maps(predicted, used, metric, seen_lens, images, chosen.confidence)
        without = [photos[p].name for p in used if metric.depths[p] is None]
        progress(1.0)
        return Reconstruction(
            used,
            metric.lens,
            kept,
            maps,
            sparse_points(list(maps), kept),
            refused,
            (
                LICENCE,
                backend_run("MASt3R", answer.facts, weights),
                *depth_unaligned("MASt3R", "the markers", without, len(used)),
            ),
        )


def cameras_of(answer: Answer, plan: Preparation) -> tuple[Intrinsics, tuple[Pose, ...]]:
    """The photos' shared lens, and ``cam_from_world`` of each in MASt3R's frame and unit."""
    focal, centre = float(np.mean(answer.arrays["focal"])), answer.arrays["centre"].astype(float).mean(0)
    poses = []
    for matrix in answer.arrays["cam_to_world"].astype(float):
        # Single precision leaves rotations off by 1e-6: the nearest exact one counts.
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        poses.append(Pose(u @ vt, matrix[:3, 3]).inverse())
    return plan.photo_lens(focal, centre), tuple(poses)


def predicted_by(answer: Answer) -> Predicted:
    """Depth and confidence with the lens that each photo's depth belongs to."""
    height, width = answer.arrays["depth"].shape[1:]
    lenses = tuple(
        Intrinsics(width, height, float(focal), float(cx), float(cy))
        for focal, (cx, cy) in zip(answer.arrays["focal"], answer.arrays["centre"], strict=True)
    )
    return Predicted(lenses, answer.arrays["depth"], answer.arrays["confidence"])

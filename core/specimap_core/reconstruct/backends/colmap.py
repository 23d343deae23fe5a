"""The ``colmap`` backend: poses from markers, features where markers do not reach, dense depth
from rectified pairs on the CPU."""

from __future__ import annotations

from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.backend import (
    CornersInPhotos,
    Progress,
    Reconstruction,
    ReconstructSettings,
    sparse_points,
)
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.reconstruct.poses import pose_photos


class ColmapBackend:
    """Markers first, COLMAP's features for the rest."""

    name = "colmap"

    def reconstruct(
        self,
        photos: list[Photo],
        corners: CornersInPhotos,
        settings: ReconstructSettings,
        *,
        workers: int,
        progress: Progress,
    ) -> Reconstruction:
        """See :class:`specimap_core.reconstruct.backend.ReconstructionBackend`."""
        posed = pose_photos(photos, corners, settings, workers=workers, progress=lambda share: progress(0.15 * share))
        progress(0.15)
        maps = dense_depth(
            [photos[p].image for p in posed.photos],
            posed.lens,
            posed.poses,
            volume_over(posed.corners, posed.poses),
            settings.depth,
            workers=workers,
            progress=lambda share: progress(0.15 + 0.85 * share),
        )
        return Reconstruction(
            posed.photos,
            posed.lens,
            posed.poses,
            tuple(maps),
            sparse_points(maps, posed.poses),
            posed.refused,
            posed.warnings,
        )

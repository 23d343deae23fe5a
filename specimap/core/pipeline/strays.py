"""Photos whose markers contradict the pose that stage 1 gave them: left out, whatever backend posed them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from specimap.core.acquisition import Refusal
from specimap.core.adjust import triangulate
from specimap.core.reconstruct.backend import CornersInPhotos, Reconstruction
from specimap.core.reconstruct.markers import OUTLIER_PX
from specimap.core.solver import MarkerScene

OUTLIER_MEDIANS = 5.0
LEAST_LEFT = 3


def without_strays(reconstruction: Reconstruction, corners: CornersInPhotos, names: tuple[str, ...]) -> Reconstruction:
    """The reconstruction without photos in which most markers stand far from where the others put them.

    The worst is taken out first, since it moves the markers that the others are judged by. ``names``: of all photos.
    """
    while len(reconstruction.photos) > LEAST_LEFT:
        place, px = _worst(reconstruction, corners)
        if place is None:
            break
        reconstruction = _without(reconstruction, place, names, px)
    return reconstruction


def _worst(r: Reconstruction, corners: CornersInPhotos) -> tuple[int | None, float]:
    """The place of the photo that is farthest off, and by how much; None where none is."""
    order = {photo: k for k, photo in enumerate(r.photos)}
    seen = corners.seen.of(np.isin(corners.seen.photo, r.photos))
    seen = replace(seen, photo=np.array([order[int(p)] for p in seen.photo], int))
    placed = triangulate(r.lens, r.poses, seen, len(corners.marker_ids))
    known = np.asarray(np.isfinite(placed).all(axis=(1, 2)), bool)
    seen = seen.of(known[seen.marker])
    if not len(seen.photo):
        return None, 0.0
    off = np.sqrt((MarkerScene(r.lens, r.poses, placed, None).residuals(seen) ** 2).sum(-1).mean(1))
    photos = np.unique(seen.photo)
    medians = np.array([float(np.median(off[seen.photo == p])) for p in photos])
    limit = max(OUTLIER_PX, 0.004 * max(r.lens.width, r.lens.height), OUTLIER_MEDIANS * float(np.median(medians)))
    worst = int(medians.argmax())
    return (int(photos[worst]), float(medians[worst])) if medians[worst] > limit else (None, 0.0)


def _without(r: Reconstruction, place: int, names: tuple[str, ...], px: float) -> Reconstruction:
    reason = f"Its markers stand {px:.0f} px from where the others show them."
    return replace(
        r,
        photos=r.photos[:place] + r.photos[place + 1 :],
        poses=r.poses[:place] + r.poses[place + 1 :],
        maps=tuple(
            replace(m, photo=m.photo - (m.photo > place)) for m in r.maps if m.photo != place
        ),
        refused=(*r.refused, Refusal(names[r.photos[place]], "photo_foreign", reason)),
    )  # fmt: skip

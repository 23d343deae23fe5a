"""A phantom whose photos stand close enough for features, with the corners that few of them show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Pose, View, fit_similarity, skew
from specimap_core.photos.reading import Photo, sharpness_of
from specimap_core.reconstruct.backend import CornersInPhotos, corners_in_photos, detect_in_photos
from specimap_core.reconstruct.features import sift
from specimap_core.reconstruct.features.base import Features, Pairs
from specimap_validation.phantom import PhantomSettings
from specimap_validation.phantom.phantom import Phantom

RING = slice(10, 20)
"""Of 24 photos the ten at 56 degrees, about 20 degrees apart as seen from the specimen."""


@dataclass(frozen=True)
class Ring:
    """Photos around the specimen in order, their true cameras, the markers' true corners, and the corners read."""

    photos: list[Photo]
    views: list[View]
    marker_corners: Floats
    corners: CornersInPhotos

    def shown_in(self, photos: list[int]) -> CornersInPhotos:
        """The corners, as if the other photos showed no marker."""
        return CornersInPhotos(self.corners.seen.of(np.isin(self.corners.seen.photo, photos)), self.corners.marker_ids)

    def errors_deg(self, photos: tuple[int, ...], poses: tuple[Pose, ...], corners: Floats, ids: list[int]) -> Floats:
        """Angles between poses and the true ones, in the frame of the true ``corners`` (Q, 4, 3) of markers ``ids``."""
        true = self.marker_corners[ids].reshape(-1, 3)
        _, R, t = fit_similarity(corners.reshape(-1, 3), true)
        back = Pose(R, t).inverse()
        return np.array(
            [angle_deg(pose @ back, self.views[k].cam_from_world) for k, pose in zip(photos, poses, strict=True)]
        )


def angle_deg(a: Pose, b: Pose) -> float:
    """Angle between two orientations."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a.R.T @ b.R) - 1) / 2, -1, 1))))


def photo_of(name: str, image: NDArray[np.uint8]) -> Photo:
    """An image (H, W, 3) as a photo."""
    height, width = image.shape[:2]
    return Photo(name, image, (width, height), None, None, sharpness_of(image), name)


def ring(texture_contrast: float) -> Ring:
    """Ten photos of 384 pixels."""
    phantom = Phantom(
        PhantomSettings(
            photo_size=384, bands=2, cube_rows=32, cube_cols=32, mesh_divisions=64, texture_contrast=texture_contrast
        )
    )
    photos = [photo_of(name, image) for name, image in phantom.photos()][RING]
    found = detect_in_photos(photos, "DICT_4X4_50", workers=2, progress=lambda share: None)
    corners = corners_in_photos(photos, found, "DICT_4X4_50")
    return Ring(photos, phantom.views[RING], phantom.scene.cards.corners, corners)


def epipolar_px(views: tuple[View, View], xy: tuple[Floats, Floats]) -> Floats:
    """Distances (M,) of the second photo's pixels from the epipolar lines of the first's; lenses without distortion."""
    a, b = views
    relative = b.cam_from_world @ a.cam_from_world.inverse()
    inverse = [np.linalg.inv(v.intrinsics.matrix) for v in views]
    fundamental = inverse[1].T @ skew(relative.t) @ relative.R @ inverse[0]
    first, second = (np.concatenate([x, np.ones((len(x), 1))], 1) for x in xy)
    lines = first @ fundamental.T
    return np.asarray(np.abs((second * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1))


@pytest.fixture(scope="module")
def remembered_sift() -> Iterator[None]:
    """SIFT looks at each photo, and at each pair of them, once in a module: most of a test's time goes there."""
    extract, match = sift.extract, sift.match
    of_photos: dict[int, tuple[Photo, Features]] = {}
    of_pairs: dict[tuple[int, int], tuple[Features, Features, Pairs]] = {}

    def extract_once(photo: Photo) -> Features:
        if id(photo) not in of_photos:
            of_photos[id(photo)] = photo, extract(photo)
        return of_photos[id(photo)][1]

    def match_once(a: Features, b: Features) -> Pairs:
        key = id(a), id(b)
        if key not in of_pairs:
            of_pairs[key] = a, b, match(a, b)
        return of_pairs[key][2].copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sift, "extract", extract_once)
        patch.setattr(sift, "match", match_once)
        yield

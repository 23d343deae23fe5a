"""A phantom's photos and cube, broken as captures are: a card moved, a photo of elsewhere, a cube of another place."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View
from tests.support.scenes import OnDisk

TRAY_GREY = (120, 120, 120)


def copied(photos: Path, folder: Path, *, stem: str = "", step: int = 1) -> Path:
    """Copy every ``step``-th photo, its name led by ``stem``."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(photos.iterdir())[::step]:
        shutil.copy(path, folder / f"{stem}{path.name}")
    return folder


def image_of(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, np.uint8)


def card_moved(small: OnDisk, folder: Path, *, marker: int, by_mm: tuple[float, float], photos: slice) -> list[str]:
    """In some of the photos in ``folder`` a card lies elsewhere; returns their names."""
    views = {Path(n).name: v for n, v in zip(small.truth.photo_names, small.truth.views, strict=True)}
    paths = sorted(folder.iterdir())[photos]
    for path in paths:
        moved = _moved(image_of(path), views[path.name], small.truth.marker_corners[marker], np.array([*by_mm, 0.0]))
        cv2.imwrite(str(path), moved, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return [path.name for path in paths]


def _moved(image: NDArray[np.uint8], view: View, corners: Floats, by: Floats) -> NDArray[np.uint8]:
    middle = corners.mean(0)
    card = middle + 1.5 * (corners - middle)
    here, there = (view.project(c).astype(np.float32) for c in (card, card + by))
    size = image.shape[1::-1]
    turn = cv2.getPerspectiveTransform(here, there)
    shown = cv2.warpPerspective(image, turn, size, flags=cv2.INTER_CUBIC)
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(there).astype(np.int32), 255)
    bare = image.copy()
    cv2.fillConvexPoly(bare, np.round(here).astype(np.int32), TRAY_GREY)
    return np.where(mask[..., None] > 0, shown, bare).astype(np.uint8)


def sheared(path: Path, by_px: float) -> None:
    """A photo as an editor leaves it: its right side ``by_px`` lower than its left."""
    image = image_of(path)
    height, width = image.shape[:2]
    matrix = np.array([[1, 0, 0], [by_px / width, 1, -by_px / 2]], float)
    cv2.imwrite(str(path), cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_CUBIC))


def cut_out(path: Path, margin: float) -> None:
    """A photo of which a corner was cut away, enlarged to its old size."""
    image = image_of(path)
    height, width = image.shape[:2]
    part = image[: round(height * (1 - margin)), : round(width * (1 - margin))]
    cv2.imwrite(str(path), cv2.resize(part, (width, height), interpolation=cv2.INTER_CUBIC))


def without_markers(path: Path, phantom: OnDisk) -> None:
    """Paint grey over the cards in a photo."""
    image = cv2.imread(str(path))
    assert image is not None
    names = [Path(n).name for n in phantom.truth.photo_names]
    view = phantom.truth.views[names.index(path.name)]
    for corners in phantom.truth.marker_corners:
        middle = corners.mean(0)
        card = np.round(view.project(middle + 1.3 * (corners - middle))).astype(np.int32)
        cv2.fillConvexPoly(image, card, TRAY_GREY)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 95])

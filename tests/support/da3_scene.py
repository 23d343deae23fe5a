"""The small phantom as the ``da3`` backend is given it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, Photo, read_photos
from specimap_core.reconstruct.backend import (
    CornersInPhotos,
    Progress,
    Reconstruction,
    ReconstructSettings,
    corners_in_photos,
    detect_in_photos,
)
from specimap_core.reconstruct.backends.da3.backend import CHILD, Da3Backend
from specimap_core.reconstruct.backends.da3.settings import Da3Settings
from tests.support.scenes import OnDisk


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache folder of the test's own: the sha256 of large weights is kept there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@dataclass(frozen=True)
class Captured:
    """The small phantom's photos and the corners in them."""

    photos: list[Photo]
    corners: CornersInPhotos


@pytest.fixture(scope="module")
def captured(small: OnDisk) -> Captured:
    photos = read_photos(photo_paths(small.photos), AcquisitionSettings())[0]
    found = detect_in_photos(photos, "DICT_4X4_50", workers=2, progress=lambda share: None)
    return Captured(photos, corners_in_photos(photos, found, "DICT_4X4_50"))


def reconstruct(
    captured: Captured, settings: Da3Settings, child: Path = CHILD, progress: Progress = lambda share: None
) -> Reconstruction:
    return Da3Backend(settings, child).reconstruct(
        captured.photos, captured.corners, ReconstructSettings(backend="da3"), workers=2, progress=progress
    )

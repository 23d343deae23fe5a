"""Photos that markers leave open: which features are taken, what is said, and that one may stop."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from specimap_core.errors import BackendUnavailableError, TooFewPhotosError
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct import poses as posing
from specimap_core.reconstruct import poses_from_features
from specimap_core.reconstruct.backend import CornersInPhotos, FeatureChoice, ReconstructSettings
from specimap_core.reconstruct.features import choice as features_choice
from specimap_core.reconstruct.features.base import FeatureKind, Features
from specimap_core.reconstruct.features.sift import Sift
from specimap_core.reconstruct.poses import Posed, pose_photos
from tests.support.feature_scene import Ring, ring

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("remembered_sift")]

SHOWN = [0, 1, 2, 3]
ALL = list(range(10))


@pytest.fixture(scope="module")
def scene() -> Ring:
    return ring(texture_contrast=1.0)


class Blind(Sift):
    """No features, as on tissue without texture."""

    def extract(self, photos: Sequence[Photo], quarter_turns: int = 0) -> Iterator[Features]:
        return (Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32), p.size, quarter_turns) for p in photos)


def pose(scene: Ring, corners: CornersInPhotos, choice: FeatureChoice = "auto") -> Posed:
    return pose_photos(scene.photos, corners, ReconstructSettings(features=choice))


def kinds_are(monkeypatch: pytest.MonkeyPatch, **kinds: type[Sift]) -> list[str]:
    """Put kinds in the place of the real ones; the list fills with what was asked for."""
    asked: list[str] = []

    def make(name: str, workers: int) -> FeatureKind:
        asked.append(name)
        return kinds[name](workers)

    monkeypatch.setattr(poses_from_features, "feature_kind", make)
    return asked


def installed(monkeypatch: pytest.MonkeyPatch, *missing: str) -> None:
    monkeypatch.setattr(features_choice, "find_spec", lambda name: None if name in missing else object())


def test_where_markers_suffice_no_features_are_looked_at(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = kinds_are(monkeypatch)
    posed = pose(scene, scene.corners)
    assert posed.photos == tuple(ALL)
    assert posed.warnings == ()
    assert asked == []


def test_sift_locates_what_markers_leave_open(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch)
    asked = kinds_are(monkeypatch, sift=Sift)
    heard: list[float] = []
    posed = pose_photos(scene.photos, scene.shown_in(SHOWN), ReconstructSettings(), progress=heard.append)
    assert posed.photos == tuple(ALL)
    assert asked == ["sift"]
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
    assert len(set(heard)) > 6
    errors = scene.errors_deg(posed.photos, posed.poses, posed.corners, [0, 1, 2, 3])
    # Four photos know the focal length to a per cent or so, which turns into a fraction of a degree.
    assert 1e-3 < np.median(errors) < 1
    assert errors.max() < 2
    (warning,) = posed.warnings
    assert warning.code == "features_chosen"
    assert "6 of 10 photos" in warning.message
    assert "% of the picture between the markers shows fine texture above the noise" in warning.message
    assert "SIFT, tried first and taken where 60 matches agree, located 6 of 6" in warning.message


def test_auto_goes_on_where_sift_gives_up(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch)
    asked = kinds_are(monkeypatch, sift=Blind, aliked=Sift)
    posed = pose(scene, scene.shown_in(SHOWN))
    assert asked == ["sift", "aliked"]
    assert posed.photos == tuple(ALL)
    assert "SIFT, tried first and taken where 60 matches agree, located 0 of 6" in posed.warnings[0].message
    assert "ALIKED with LightGlue, for the rest, located 6 of 6" in posed.warnings[0].message


@pytest.mark.parametrize("second", [Sift, Blind])
def test_auto_takes_a_pose_of_few_matches_only_where_aliked_finds_none(
    scene: Ring, monkeypatch: pytest.MonkeyPatch, second: type[Sift]
) -> None:
    installed(monkeypatch)
    monkeypatch.setattr(poses_from_features, "SURE_INLIERS", 10_000)
    asked = kinds_are(monkeypatch, sift=Sift, aliked=second)
    posed = pose(scene, scene.shown_in(SHOWN))
    # The second attempt with SIFT goes on with what the first described.
    assert asked == ["sift", "aliked"]
    assert posed.photos == tuple(ALL)
    assert ("SIFT, now with fewer matches, located 6 of 6" in posed.warnings[0].message) == (second is Blind)
    assert scene.errors_deg(posed.photos, posed.poses, posed.corners, [0, 1, 2, 3]).max() < 2


def test_without_aliked_a_pose_of_few_matches_is_taken_at_once(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, "torch")
    monkeypatch.setattr(poses_from_features, "SURE_INLIERS", 10_000)
    asked = kinds_are(monkeypatch, sift=Sift)
    posed = pose(scene, scene.shown_in(SHOWN))
    assert asked == ["sift"]
    assert posed.photos == tuple(ALL)
    assert "SIFT, tried first, located 6 of 6" in posed.warnings[0].message


def test_sift_alone_does_not_go_on(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = kinds_are(monkeypatch, sift=Blind)
    posed = pose(scene, scene.shown_in(SHOWN), "sift")
    assert asked == ["sift"]
    assert posed.photos == tuple(SHOWN)
    assert {r.code for r in posed.refused} == {"photo_unlocated"}
    assert len(posed.refused) == 6


def test_auto_says_that_aliked_is_absent(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, "torch")
    asked = kinds_are(monkeypatch, sift=Blind)
    posed = pose(scene, scene.shown_in(SHOWN))
    assert asked == ["sift"]
    assert "not installed" in posed.warnings[0].message


def test_aliked_that_is_absent_is_refused_first(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, "torch", "kornia")
    heard: list[float] = []
    with pytest.raises(BackendUnavailableError) as refused:
        pose_photos(scene.photos, scene.corners, ReconstructSettings(features="aliked"), progress=heard.append)
    assert refused.value.details["missing"] == ["torch", "kornia"]
    assert "make learned" in refused.value.advice
    assert heard == []


@pytest.mark.parametrize("least", [posing.LEAST_BY_MARKERS, 99], ids=["located", "motion"])
def test_a_stop_is_heard_while_features_are_at_work(scene: Ring, monkeypatch: pytest.MonkeyPatch, least: int) -> None:
    class StopError(Exception):
        pass

    heard = 0

    def stop(share: float) -> None:
        nonlocal heard
        heard += share > posing.SOLVED
        if heard > 3:
            raise StopError

    monkeypatch.setattr(posing, "LEAST_BY_MARKERS", least)
    before = threading.active_count()
    with pytest.raises(StopError):
        pose_photos(scene.photos, scene.shown_in(SHOWN), ReconstructSettings(features="sift"), progress=stop)
    assert heard == 4
    assert threading.active_count() == before


def one_and_a_bit(scene: Ring) -> CornersInPhotos:
    """All markers in one photo; in its neighbour two of them: too little to start from."""
    corners = scene.shown_in([2, 3])
    keep = (corners.seen.photo == 2) | (corners.seen.marker < 2)
    return CornersInPhotos(corners.seen.of(keep), corners.marker_ids)


def test_photos_without_markers_hang_together_by_motion(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posing, "LEAST_BY_MARKERS", 3)
    posed = pose(scene, one_and_a_bit(scene), "sift")
    assert posed.photos == tuple(ALL)
    assert posed.corners.shape == (2, 4, 3)
    errors = scene.errors_deg(posed.photos, posed.poses, posed.corners, [0, 1])
    # The frame hangs on eight corners that two photos show.
    assert 1e-3 < np.median(errors) < 2
    edges = np.linalg.norm(posed.corners - np.roll(posed.corners, -1, 1), axis=-1)
    assert abs(np.median(edges) - 6.8) < 1e-6
    cameras = posed.poses, [v.cam_from_world for v in scene.views]
    found, true = (np.stack([p.centre for p in poses]) for poses in cameras)
    sizes = [np.linalg.norm(c - c.mean(0), axis=1).mean() for c in (found, true)]
    assert sizes[0] / sizes[1] == pytest.approx(1, abs=0.05)
    assert "SIFT connected 10 of 10" in posed.warnings[0].message


def test_where_neither_reaches_it_is_refused(scene: Ring, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posing, "LEAST_BY_MARKERS", 3)
    kinds_are(monkeypatch, sift=Blind)
    with pytest.raises(TooFewPhotosError):
        pose(scene, one_and_a_bit(scene), "sift")

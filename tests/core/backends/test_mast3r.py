"""The adapter around MASt3R without MASt3R: what it makes of given predictions."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.errors import (
    BackendUnavailableError,
    DepthNotFoundError,
    MarkerGeometryError,
    PhotosNotConnectedError,
)
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Pose, fit_similarity, rotation_from_vector
from specimap_core.reconstruct.backend import Reconstruction
from specimap_core.reconstruct.backends.mast3r.backend import LICENCE
from specimap_core.reconstruct.backends.mast3r.maps import bytes_of
from specimap_core.reconstruct.backends.mast3r.settings import Mast3rSettings
from tests.support.mast3r_scene import CLOSE_MM, Seen, answer_of, reconstruct, scripted_settings, see, true_points
from tests.support.notices import messages
from tests.support.scenes import SMALL, OnDisk

FRAME = Pose(rotation_from_vector(np.array([0.3, -1.1, 0.7])), np.array([20.0, -5.0, 90.0]))
"""Between the phantom's world and that of the predictions."""


@pytest.fixture(scope="module")
def seen(small: OnDisk) -> Seen:
    return see(small.photos, SMALL, 192)


@pytest.fixture
def settings(tmp_path: Path) -> Mast3rSettings:
    return scripted_settings(tmp_path, 192)


def errors_mm(found: Reconstruction, seen: Seen, small: OnDisk) -> list[Floats]:
    """Distances of each map's points from what is truly there, after a rigid fit of the cameras."""
    truth = [small.truth.views[p].cam_from_world for p in found.photos]
    _, R, t = fit_similarity(np.stack([p.centre for p in found.poses]), np.stack([p.centre for p in truth]))
    return [
        np.linalg.norm(m.points(found.poses[m.photo]) @ R.T + t - true, axis=1)
        for m, true in zip(found.maps, true_points(found, seen), strict=True)
    ]


# ---- good predictions ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_exact_predictions_come_out_in_the_marker_frame(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = reconstruct(seen, answer_of(seen, frame=FRAME), settings, monkeypatch)
    assert found.photos == tuple(range(12))
    assert found.refused == ()
    assert len(found.maps) == 12
    apart = errors_mm(found, seen, small)
    assert 1e-3 < float(np.median(np.concatenate(apart))) < CLOSE_MM
    assert max(float(np.median(a)) for a in apart) < 2 * CLOSE_MM
    true = small.truth.views[0].intrinsics
    assert found.lens.focal_px == pytest.approx(true.focal_px, rel=2e-3)
    assert all(np.array_equal(m.turn, np.eye(3)) for m in found.maps)
    # Only what stands between the markers is kept, and it is coloured as the photo is.
    assert all(0.1 < (m.depth > 0).mean() <= 1 and m.depth.shape < (192, 192) for m in found.maps)
    m = found.maps[0]
    left = round(seen.plan.to_network(np.array([found.lens.cx, 0]))[0] - m.intrinsics.cx)
    assert np.abs(m.colour.astype(int).mean((0, 1)) - seen.images[0][:, left:].mean((0, 1))).max() < 40


@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_a_focal_length_off_by_a_fiftieth_is_made_good_by_the_markers(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    found = reconstruct(seen, answer_of(seen, focal_factor=factor), settings, monkeypatch)
    assert found.lens.focal_px == pytest.approx(small.truth.views[0].intrinsics.focal_px, rel=2e-3)
    assert 1e-3 < float(np.median(np.concatenate(errors_mm(found, seen, small)))) < CLOSE_MM


def test_a_photo_without_a_marker_is_kept_and_in_its_place(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = replace(seen, corners=replace(seen.corners, seen=_without(seen.corners.seen, 3)))
    found = reconstruct(bare, answer_of(seen, frame=FRAME, focal_factor=1.01), settings, monkeypatch)
    assert found.photos == tuple(range(12))
    own = [a for m, a in zip(found.maps, errors_mm(found, seen, small), strict=True) if m.photo == 3]
    assert len(own) == 1
    # Its place follows from the other photos' points by an affine map, which is exact to first order only.
    assert 1e-3 < float(np.median(own[0])) < 3 * CLOSE_MM


def test_unsure_depth_is_dropped_and_the_rest_graded(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = answer_of(seen)
    arrays["confidence"][:, :, 96:] = 1.2
    found = reconstruct(seen, arrays, settings, monkeypatch)
    for m in found.maps:
        assert m.intrinsics.cx == pytest.approx(96, abs=96)
        assert ((m.confidence > 0) == (m.depth > 0)).all()
    sure = np.concatenate([m.confidence[m.depth > 0] for m in found.maps])
    assert set(sure) == {bytes_of(np.array(5.0), 1.5).item()}
    widths = [m.depth.shape[1] for m in found.maps]
    assert max(widths) <= 98
    assert list(bytes_of(np.array([1.0, 1.5, 3.0, 1e9]), 1.5)) == [1, 1, 128, 255]


def test_the_report_tells_licence_weights_and_device(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = reconstruct(seen, answer_of(seen), settings, monkeypatch)
    warnings = messages(found.warnings)
    assert LICENCE in found.warnings
    assert "non-commercial" in warnings["licence_non_commercial"]
    assert hashlib.sha256(b"weights").hexdigest() in warnings["backend_run"]
    assert "CPU" in warnings["backend_run"]
    assert settings.cache is not None
    asked = json.loads(settings.cache.with_name("answer.npz.request.json").read_text("utf-8"))
    assert asked["pairs"] == [[i, j] for i in range(12) for j in range(i + 1, 12)]
    assert asked["names"] == [p.name for p in seen.photos]
    assert asked["schedule"] == [300, 300]


# ---- bad predictions ----------------------------------------------------------------------------------


def _without(seen: Observations, photo: int) -> Observations:
    return seen.of(seen.photo != photo)


def test_a_photo_that_is_placed_wrongly_is_placed_by_its_markers(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = answer_of(seen)
    arrays["cam_to_world"][5] = arrays["cam_to_world"][8]
    found = reconstruct(seen, arrays, settings, monkeypatch)
    assert found.refused == ()
    truth = [v.cam_from_world for v in small.truth.views]
    _, R, t = fit_similarity(np.stack([p.centre for p in found.poses]), np.stack([p.centre for p in truth]))
    # At 150 mm the corners, seen to 0.2 px, leave a camera's distance open to a third of a millimetre.
    assert np.linalg.norm(R @ found.poses[5].centre + t - truth[5].centre) < 1
    # Its depth was made to fit the wrong pose.
    assert 5 not in {m.photo for m in found.maps}
    assert len(found.maps) == 11
    assert seen.photos[5].name in messages(found.warnings)["depth_unaligned"]


def test_a_photo_of_another_scene_is_refused_by_name(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    corners = seen.corners.seen
    turned = np.where((corners.photo == 5)[:, None, None], corners.corners_px[:, ::-1], corners.corners_px)
    other = replace(seen, corners=replace(seen.corners, seen=replace(corners, corners_px=turned)))
    found = reconstruct(other, answer_of(seen), settings, monkeypatch)
    assert [r.name for r in found.refused] == [seen.photos[5].name]
    assert found.refused[0].code == "photo_foreign"
    assert found.photos == (0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11)
    assert {m.photo for m in found.maps} == set(range(11))


def test_many_photos_placed_wrongly_are_two_scenes(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = answer_of(seen)
    arrays["cam_to_world"][:6] = arrays["cam_to_world"][6:]
    with pytest.raises(PhotosNotConnectedError, match="contradict"):
        reconstruct(seen, arrays, settings, monkeypatch)


def test_no_sure_depth_at_all(seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays = answer_of(seen)
    arrays["confidence"][:] = 1.0
    with pytest.raises(DepthNotFoundError, match="sure of no depth"):
        reconstruct(seen, arrays, settings, monkeypatch)


def test_no_marker_in_two_photos(seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    corners = replace(seen.corners, seen=seen.corners.seen.of(seen.corners.seen.photo == 0))
    with pytest.raises(MarkerGeometryError, match="two posed photos"):
        reconstruct(replace(seen, corners=corners), answer_of(seen), settings, monkeypatch)


# ---- what is missing ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"home": None}, "SPECIMAP_MAST3R_HOME"),
        ({"home": Path("/nowhere")}, "git submodule update"),
        ({"weights": None}, "SPECIMAP_MAST3R_WEIGHTS"),
        ({"weights": Path("/nowhere.pth")}, "SPECIMAP_MAST3R_WEIGHTS"),
        ({"weights_sha256": "0" * 64}, "SPECIMAP_MAST3R_WEIGHTS_SHA256"),
        ({"python": "/nowhere/python"}, "SPECIMAP_MAST3R_PYTHON"),
    ],
)
def test_what_is_missing_is_named(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch, change: dict[str, object], says: str
) -> None:
    with pytest.raises(BackendUnavailableError) as caught:
        reconstruct(seen, answer_of(seen), replace(settings, **change), monkeypatch)  # type: ignore[arg-type]
    assert says in caught.value.advice

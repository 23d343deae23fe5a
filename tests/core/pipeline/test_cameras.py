"""The cameras that a run writes: held against a phantom's truth, by the formulas of docs/formats.md alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.arrays import Floats
from specimap_core.cloud import Cloud
from specimap_core.geometry.cameras import Intrinsics, Pose, View, fit_similarity, look_at
from specimap_core.geometry.pushbroom import Axis, ScanView
from specimap_core.pipeline.cameras import cube_camera
from specimap_core.register.cube_camera import CubeCamera
from specimap_core.report.cameras import Cameras
from tests.support.scenes import Finished, OnDisk, read_corners, rotation_deg


def cameras(finished: Finished) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((finished.out / "cameras.json").read_text(encoding="utf-8"))
    return found


def pose_of(camera: dict[str, Any]) -> Pose:
    matrix = np.array(camera["cam_from_world"], float)
    assert matrix.shape == (3, 4)
    return Pose(matrix[:, :3], matrix[:, 3])


def projected(camera: dict[str, Any], points: Floats) -> Floats:
    """As the page of formats says, of places (N, 3) mm in the marker frame: x, y in pixels (N, 2)."""
    matrix, lens = np.array(camera["cam_from_world"], float), camera["camera"]
    places = points @ matrix[:, :3].T + matrix[:, 3]
    focal, middle = np.array(lens["focal_px"]), np.array(lens["principal_point_px"])
    if lens["model"] == "pinhole":
        xy = places[:, :2] / places[:, 2:]
        r2 = (xy**2).sum(1, keepdims=True)
        k1, k2 = lens["distortion"]
        return np.asarray(middle + focal * xy * (1 + k1 * r2 + k2 * r2**2))
    scan = camera["scan"]
    s, o = (1, 0) if scan["along"] == "rows" else (0, 1)
    found = np.empty((len(points), 2))
    found[:, s] = middle[s] + focal[s] * places[:, s] / scan["depth_mm"]
    across = places[:, o] - scan["skew"] * places[:, s]
    found[:, o] = middle[o] + focal[o] * across / (places[:, 2] - scan["climb"] * places[:, s])
    return found


def test_the_file_holds_the_photos_used_in_the_report_s_order(finished: Finished) -> None:
    found = cameras(finished)
    assert (found["frame"], found["units"]) == ("marker", "mm")
    assert [photo["name"] for photo in found["photos"]] == finished.report.photos.used
    assert Cameras.model_validate(found).text() == (finished.out / "cameras.json").read_text(encoding="utf-8")
    for photo in found["photos"]:
        rotation = pose_of(photo).R
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-8)
        assert np.linalg.det(rotation) > 0
        assert photo["camera"]["focal_px"][0] == pytest.approx(finished.report.photo_focal_px, abs=1e-6)
        # The marker frame's z points toward the cameras.
        assert pose_of(photo).centre[2] > 20


def test_photos_were_taken_from_where_they_say(finished: Finished, small: OnDisk) -> None:
    ids, corners = read_corners(finished.out)
    true_corners = dict(zip(small.truth.marker_ids.tolist(), small.truth.marker_corners, strict=True))
    own, true = corners.reshape(-1, 3), np.array([true_corners[i] for i in ids]).reshape(-1, 3)
    _, turn, shift = fit_similarity(own, true)
    views = dict(zip((Path(name).name for name in small.truth.photo_names), small.truth.views, strict=True))
    away_mm, away_deg, away_px, residuals = [], [], [], []
    for photo in cameras(finished)["photos"]:
        view, pose = views[photo["name"]], pose_of(photo)
        assert (photo["width"], photo["height"]) == (view.intrinsics.width, view.intrinsics.height)
        in_truth = pose @ Pose(turn, shift).inverse()
        away_mm.append(float(np.linalg.norm(in_truth.centre - view.cam_from_world.centre)))
        away_deg.append(rotation_deg(in_truth, view.cam_from_world))
        away_px.append(np.abs(projected(photo, own) - view.project(true)).max())
        residuals.append(photo["residual_px"])
    # At most about three times what this phantom gives; no error at all would be a broken test.
    assert 1e-3 < np.median(away_mm) < 0.1
    assert max(away_mm) < 0.3
    assert 1e-4 < np.median(away_deg) < 0.05
    assert max(away_deg) < 0.15
    assert 1e-3 < np.median(away_px) < 0.15
    assert max(away_px) < 0.3
    rms = float(np.sqrt(np.mean(np.square(residuals))))
    assert rms == pytest.approx(finished.report.reprojection_px.after, rel=0.1)


def test_the_cube_s_camera_sees_each_point_in_its_pixel(finished: Finished, small: OnDisk) -> None:
    camera, cloud = cameras(finished)["cube"], Cloud.open(finished.out / "cloud.zarr")
    rows, cols = small.truth.hsi_class.shape
    assert (camera["height"], camera["width"]) == (rows, cols)
    seen = projected(camera, cloud.xyz.astype(float))
    if camera["mirrored"]:
        seen[:, 0] = cols - 1 - seen[:, 0]
    away = np.linalg.norm(seen[:, ::-1] - cloud.hsi_pixel, axis=1)
    # The cloud's positions are single precision.
    assert 0 < np.percentile(away, 99) < 1e-4
    assert camera["residual_px"] == pytest.approx(finished.report.cube_camera.reprojection_rms_px, abs=1e-4)


LENS = Intrinsics(300, 200, 900.0, 151.0, 98.0, aspect=1.1)
POSE = look_at(np.array([20.0, -10.0, 180.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))


def scanned(axis: Axis) -> ScanView:
    return ScanView(LENS, POSE, axis, skew=0.02, climb=-0.01, depth_mm=170.0)


@pytest.mark.parametrize(
    "view", [View(LENS, POSE), scanned("rows"), scanned("columns")], ids=["frame", "rows", "columns"]
)
def test_every_kind_of_camera_is_described_by_its_formula(view: View) -> None:
    described = cube_camera(CubeCamera(view, 0.123456, 0.01, np.eye(7)), mirrored=True).model_dump(mode="json")
    assert (described["camera"]["model"] == "push_broom") == isinstance(view, ScanView)
    assert (described["scan"] is not None) == isinstance(view, ScanView)
    assert (described["mirrored"], described["residual_px"]) == (True, 0.1235)
    points = np.random.default_rng(3).uniform(-20, 20, (200, 3))
    assert np.abs(projected(described, points) - view.project(points)).max() < 1e-4

"""Incremental structure from motion on image features (COLMAP, Schoenberger 2016), where markers pose too few photos.

One shared lens with one radial term. Frame and scale are brought in by marker corners that two photos show.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import MarkerScene
from specimap_core.fiducials.layout import edge_lengths, marker_frame
from specimap_core.fiducials.observations import Observations
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.colmap_cameras import colmap_from_opencv, opencv_from_colmap
from specimap_core.native import quiet_colmap
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.features.base import FeatureKind, Features
from specimap_core.reconstruct.features.sift import match

FOCAL_START = 1.2
"""Focal length to start from, in longer sides, where EXIF states none (COLMAP's own choice)."""
LEAST_PHOTOS = 3
CORNERS_PX = 10.0
"""A marker whose triangulated corners miss what the photos show by more, RMS, is a false reading."""

Tick = Callable[[], None]


@dataclass(frozen=True)
class Motion:
    """``poses``: ``cam_from_world`` of the connected photos, by their index, in any frame and scale."""

    lens: Intrinsics
    poses: dict[int, Pose]

    def in_marker_frame(self, seen: Observations, count: int, edge_mm: float) -> tuple[dict[int, Pose], Floats] | None:
        """Poses in the marker frame, mm, and the corners (Q, 4, 3) mm of the markers that two posed photos show.

        ``seen.photo`` indexes the photos, ``seen.marker`` runs to ``count``. None where no marker gives a scale.
        """
        order = sorted(self.poses)
        posed = seen.of(np.isin(seen.photo, order))
        inner = Observations(np.searchsorted(order, posed.photo), posed.marker, posed.corners_px, posed.sigma_px)
        poses = tuple(self.poses[p] for p in order)
        corners = triangulate(self.lens, poses, inner, count)
        missed = (MarkerScene(self.lens, poses, corners, None).residuals(inner) ** 2).sum(-1).mean(1)
        fits = [
            m
            for m in range(count)
            if np.isfinite(corners[m]).all() and np.sqrt(missed[inner.marker == m].mean()) < CORNERS_PX
        ]
        if not fits:
            return None
        corners = corners[fits]
        scale = edge_mm / float(np.median(edge_lengths(corners)))
        scaled = {p: Pose(pose.R, scale * pose.t) for p, pose in self.poses.items()}
        frame = marker_frame(scale * corners, np.stack([p.centre for p in scaled.values()]))
        back = frame.inverse()
        return {p: pose @ back for p, pose in scaled.items()}, frame.apply(scale * corners)


def structure_from_motion(
    photos: list[Photo], kind: FeatureKind, focal_px: float | None, *, seed: int, workers: int, tick: Tick
) -> Motion | None:
    """Poses of the largest set of connected photos (of one size); None where that is fewer than three.

    ``focal_px``: from EXIF. ``tick`` is called between steps; what it raises ends the work.
    """
    quiet_colmap()
    features = []
    for one in kind.extract(photos):
        features.append(one)
        tick()
    with tempfile.TemporaryDirectory(prefix="specimap-motion-") as scratch:
        path = Path(scratch) / "features.db"
        _write_database(path, photos[0].size, features, kind, focal_px, seed, tick)
        model = _map(path, Path(scratch), seed, workers, tick)
    if model is None:
        return None
    camera = next(iter(model.cameras.values()))
    focal, cx, cy, k1 = (float(v) for v in camera.params)
    cx, cy = opencv_from_colmap(np.array([cx, cy]))
    lens = Intrinsics(camera.width, camera.height, focal, float(cx), float(cy), k1)
    poses = {}
    for image_id in model.reg_image_ids():
        matrix = model.image(image_id).cam_from_world().matrix()
        poses[int(model.image(image_id).name)] = Pose(matrix[:, :3].copy(), matrix[:, 3].copy())
    return Motion(lens, poses)


def _pairs(features: list[Features], shortlist: int | None, tick: Tick) -> list[tuple[int, int]]:
    """Pairs to match: all, or for each photo those most alike where matching is dear."""
    n = len(features)
    every = [(i, j) for i in range(n) for j in range(i + 1, n)]
    if shortlist is None:
        return every
    alike = np.zeros((n, n), int)
    for i, j in every:
        alike[i, j] = alike[j, i] = len(match(features[i], features[j]))
        tick()
    np.fill_diagonal(alike, -1)
    best = {(i, int(j)) for i in range(n) for j in np.argsort(-alike[i], kind="stable")[:shortlist]}
    return sorted({(min(p), max(p)) for p in best if p[0] != p[1]})


def _write_database(
    path: Path,
    size: tuple[int, int],
    features: list[Features],
    kind: FeatureKind,
    focal_px: float | None,
    seed: int,
    tick: Tick,
) -> None:
    """Keypoints, matches and verified pairs in COLMAP's own form; a photo's name is its index."""
    width, height = size
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=[focal_px or FOCAL_START * max(size), width / 2, height / 2, 0.0],
    )
    camera.has_prior_focal_length = focal_px is not None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    places = [colmap_from_opencv(f.xy) for f in features]
    with pycolmap.Database.open(path) as database:
        camera.camera_id = database.write_camera(camera)
        ids = []
        for k, xy in enumerate(places):
            ids.append(database.write_image(pycolmap.Image(name=str(k), camera_id=camera.camera_id)))
            database.write_keypoints(ids[k], xy.astype(np.float32))
        pairs = _pairs(features, kind.shortlist, tick)
        found = kind.match([(features[i], features[j]) for i, j in pairs])
        for (i, j), matches in zip(pairs, found, strict=True):
            tick()
            if len(matches) < options.min_num_inliers:
                continue
            indices = np.ascontiguousarray(matches, np.uint32)
            verified = pycolmap.estimate_two_view_geometry(camera, places[i], camera, places[j], indices, options)
            database.write_matches(ids[i], ids[j], indices)
            database.write_two_view_geometry(ids[i], ids[j], verified)


def _map(database: Path, scratch: Path, seed: int, workers: int, tick: Tick) -> pycolmap.Reconstruction | None:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = LEAST_PHOTOS
    options.extract_colors = False
    options.num_threads = workers
    options.random_seed = seed
    stop, raised = pycolmap.CancellationToken(), list[BaseException]()

    def listen() -> None:
        # An exception cannot pass through COLMAP's threads: it waits outside.
        try:
            tick()
        except BaseException as error:
            raised.append(error)
            stop.cancel()

    models = pycolmap.incremental_mapping(
        database,
        scratch,
        scratch,
        options,
        initial_image_pair_callback=listen,
        next_image_callback=listen,
        cancellation_token=stop,
    )
    if raised:
        raise raised[0]
    largest = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return largest if largest is not None and largest.num_reg_images() >= LEAST_PHOTOS else None

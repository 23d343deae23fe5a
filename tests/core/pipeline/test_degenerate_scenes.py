"""No stage answers a scene that cannot work with a library's exception: each refusal has a code of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import AdjustSettings, Form, adjust
from specimap_core.cloud import Cloud
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import open_cube
from specimap_core.errors import MemoryExhaustedError, SpecimapError, StageFailedError
from specimap_core.export import export_cloud
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.pipeline.clock import Clock
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.reconstruct.poses_from_markers import solve_from_markers
from specimap_core.register.placement import fit_homography, place_by_camera, place_by_homography
from specimap_core.register.points import cloud_points
from specimap_core.render.orthographic import extent_of, render_grid
from specimap_core.surface.fusion import Mesh, fuse, vertex_normals
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.refinement import refine_mesh
from specimap_core.surface.settings import RefineSettings, SurfaceSettings
from specimap_core.surface.uncertainty import mesh_sigma
from tests.support.scenes import UNNAMED, bump_mesh, marker_scene

SWEEP = settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
SLOW_SWEEP = settings(SWEEP, max_examples=25)


@contextmanager
def refused_by_name() -> Iterator[None]:
    """Whatever ends the work within is a refusal with a code of its own; an answer is as good."""
    refusal: SpecimapError | None = None
    try:
        yield
    except SpecimapError as error:
        refusal = error
    if refusal is not None:
        assert refusal.code not in UNNAMED, refusal
        assert refusal.advice, refusal


# ---- markers ------------------------------------------------------------------------------------------

CORNERS: dict[str, Callable[[Floats, np.random.Generator], Floats]] = {
    "as they are": lambda c, rng: c,
    "all alike": lambda c, rng: np.broadcast_to(c[0], c.shape).copy(),
    "on a line": lambda c, rng: np.stack([c[..., 0], np.full_like(c[..., 1], 100.0)], -1),
    "in a point": lambda c, rng: np.broadcast_to(c.mean(1, keepdims=True), c.shape).copy(),
    "anywhere": lambda c, rng: rng.uniform(0, 600, c.shape),
    "mirrored": lambda c, rng: c[:, ::-1],
    "coarse": lambda c, rng: np.round(c / 50) * 50,
    "tiny": lambda c, rng: np.broadcast_to([[0, 0], [1e-3, 0], [1e-3, 1e-3], [0, 1e-3]], c.shape).copy(),
    "far outside": lambda c, rng: c + 1e5,
}


@pytest.mark.slow
@SWEEP
@given(
    seed=st.integers(0, 10_000),
    photos=st.integers(1, 6),
    markers=st.integers(1, 4),
    noise_px=st.sampled_from([0.0, 0.1, 5.0, 200.0]),
    kind=st.sampled_from(sorted(CORNERS)),
    shown=st.floats(0.2, 1.0),
    form=st.sampled_from(["rigid", "free"]),
)
def test_markers_of_any_kind(
    seed: int, photos: int, markers: int, noise_px: float, kind: str, shown: float, form: Form
) -> None:
    rng = np.random.default_rng(seed)
    _, seen = marker_scene(photos=photos, markers=markers, noise_px=noise_px, seed=seed)
    keep = rng.random(len(seen.photo)) < shown
    keep[0] = True
    seen = replace(seen, corners_px=CORNERS[kind](seen.corners_px, rng)).of(keep)
    with refused_by_name():
        found = solve_from_markers(seen, tuple(range(markers)), (640, 480), edge_mm=6.8)
        adjusted = adjust(found.scene.lens, found.scene.poses, found.seen, found.markers, AdjustSettings(form=form))
        assert np.isfinite(adjusted.corners).all()
        assert np.isfinite(adjusted.covariance).all()
        assert all(np.isfinite(pose.t).all() for pose in adjusted.poses)


# ---- depth and surface --------------------------------------------------------------------------------


def layout(ring_mm: float) -> Floats:
    """Corners (4, 4, 3) of four markers."""
    square = 3.4 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    return np.stack([square + ring_mm * np.array([x, y, 0.0]) for x, y in ((-1, 0), (1, 0), (0, 1), (0, -1))])


def ring_of_cameras(count: int, distance_mm: float, rng: np.random.Generator, *, same: bool) -> tuple[Pose, ...]:
    """Cameras all around, or all at one place."""
    poses = []
    for k in range(count):
        azimuth = 0.0 if same else 2 * np.pi * k / count
        up = np.radians(45.0 if same else rng.uniform(10, 80))
        eye = np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        poses.append(look_at(distance_mm * eye, np.zeros(3), np.array([0, 0, 1.0])))
    return tuple(poses)


DEPTHS: dict[str, Callable[[int, float, np.random.Generator], Floats]] = {
    "none": lambda n, d, rng: np.zeros((n, n)),
    "plane": lambda n, d, rng: np.full((n, n), d),
    "speck": lambda n, d, rng: np.pad(np.full((2, 2), d), (n - 2) // 2),
    "noise": lambda n, d, rng: rng.uniform(0, 2 * d, (n, n)),
    "not a number": lambda n, d, rng: np.full((n, n), np.nan),
    "infinite": lambda n, d, rng: np.full((n, n), np.inf),
}


@pytest.mark.slow
@SWEEP
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 5),
    size=st.sampled_from([16, 64, 128]),
    distance_mm=st.sampled_from([0.5, 30.0, 150.0, 5000.0]),
    same=st.booleans(),
    black=st.booleans(),
    ring_mm=st.sampled_from([1.0, 20.0, 500.0]),
    kind=st.sampled_from(sorted(DEPTHS)),
)
def test_depth_of_any_kind(
    seed: int, count: int, size: int, distance_mm: float, same: bool, black: bool, ring_mm: float, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    lens = Intrinsics.centred(size, size, 1.5 * size)
    poses = ring_of_cameras(count, distance_mm, rng, same=same)
    images = [rng.integers(0, 1 if black else 255, (size, size, 3)).astype(np.uint8) for _ in poses]
    with refused_by_name():
        found = dense_depth(images, lens, poses, volume_over(layout(ring_mm)), DepthSettings(), workers=1)
        assert all(np.isfinite(one.depth).all() for one in found)
    depth = DEPTHS[kind](size, distance_mm, rng).astype(np.float32)
    sure, colour = np.full((size, size), 255, np.uint8), np.zeros((size, size, 3), np.uint8)
    given_maps = [DepthMap(k, np.eye(3), lens, depth, sure, colour) for k in range(count)]
    with refused_by_name():
        mesh = fuse(given_maps, poses, max(distance_mm / lens.focal_px, 0.05), SurfaceSettings())
        assert np.isfinite(mesh.vertices).all()


# ---- from a mesh to a cloud and its exports -----------------------------------------------------------

Shape = tuple[np.ndarray[tuple[int, ...], np.dtype[np.float32]], np.ndarray[tuple[int, ...], np.dtype[np.int32]]]
MESHES: dict[str, Callable[[Mesh], Shape]] = {
    "bump": lambda m: (m.vertices, m.triangles),
    "one triangle": lambda m: (m.vertices, m.triangles[:1]),
    "a point": lambda m: (m.vertices * 0, m.triangles),
    "flat": lambda m: (m.vertices * np.array([1, 1, 0], np.float32), m.triangles),
    "huge": lambda m: (m.vertices * np.float32(1e4), m.triangles),
    "tiny": lambda m: (m.vertices * np.float32(1e-4), m.triangles),
    "far away": lambda m: (m.vertices + np.float32(1e5), m.triangles),
    "inside out": lambda m: (m.vertices, m.triangles[:, ::-1].copy()),
    "below": lambda m: (m.vertices * np.array([1, 1, -1], np.float32) - np.array([0, 0, 50], np.float32), m.triangles),
}


@pytest.mark.slow
@SLOW_SWEEP
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 7),
    kind=st.sampled_from(sorted(MESHES)),
    distance_mm=st.sampled_from([1.0, 30.0, 150.0, 5000.0]),
    ring_mm=st.sampled_from([1.0, 15.0, 500.0]),
    shape=st.tuples(st.sampled_from([1, 8, 40]), st.sampled_from([1, 8, 40]), st.sampled_from([1, 2, 9])),
    fine_mm=st.sampled_from([0.5, 2.0, 1000.0]),
    by_camera=st.booleans(),
    mirrored=st.booleans(),
    values=st.sampled_from(["counts", "holes", "constant"]),
)
def test_meshes_of_any_kind(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    count: int,
    kind: str,
    distance_mm: float,
    ring_mm: float,
    shape: tuple[int, int, int],
    fine_mm: float,
    by_camera: bool,
    mirrored: bool,
    values: str,
) -> None:
    rng, folder, size = np.random.default_rng(seed), tmp_path_factory.mktemp("sweep"), 64
    lens, corners = Intrinsics.centred(size, size, 1.5 * size), layout(ring_mm)
    poses = ring_of_cameras(count, distance_mm, rng, same=False)
    vertices, triangles = MESHES[kind](bump_mesh(cell_mm=4.0))
    mesh = Mesh(vertices, triangles, vertex_normals(vertices, triangles), bump_mesh(cell_mm=4.0).colours)
    greys = [rng.integers(0, 255, (size, size)).astype(np.uint8) for _ in poses]
    depth = np.full((size, size), distance_mm, np.float32)
    whole = np.full((size, size), 255, np.uint8)
    maps = tuple(
        DepthMap(k, np.eye(3), lens, depth, whole, np.repeat(whole[..., None], 3, 2)) for k in range(count // 2)
    )
    rows, cols, bands = shape
    with refused_by_name():
        refined = refine_mesh(mesh, greys, lens, poses, 0.3, RefineSettings(), workers=1)
        sigma = mesh_sigma(refined, maps, poses, workers=1)
        assert np.isfinite(refined.mesh.vertices).all()
        assert np.isfinite(sigma).all()
        caster = RayCaster(refined.mesh)
        low, high = extent_of(corners, 4.0)
        coarse, fine = render_grid(caster, low, high, 2.0), render_grid(caster, low, high, fine_mm)
        eye = look_at(np.array([0, 0.1, 400.0]), np.zeros(3), np.array([0, 1.0, 0]))
        view = View(Intrinsics.centred(cols, rows, 120.0), eye)
        if by_camera:
            placed = place_by_camera(view, caster, mirrored)
        else:
            flat = corners.reshape(-1, 3)
            homography = fit_homography(flat, view.project(flat), coarse, 3.0)
            placed = place_by_homography(homography, coarse, fine, view, caster, mirrored)
        points = cloud_points(placed, caster, sigma.astype(np.float32), corners, 0.01, 0.02, 0.05)
        assert np.isfinite(points.sigma_mm).all()
        cube = rng.integers(0, 65535, (rows, cols, bands)).astype(np.uint16)
        if values == "constant":
            cube[:] = 7
        if values == "holes":
            cube = np.where(rng.random(cube.shape) < 0.5, np.nan, cube).astype(np.float32)
        np.save(folder / "cube.npy", cube)
        write_cloud(folder / "cloud.zarr", points, open_cube(folder / "cube.npy"), {})
        cloud = Cloud.open(folder / "cloud.zarr")
        write_preview(cloud, folder / "preview.png")
        for name in ("ply", "las", "npz", "envi", "csv"):
            export_cloud(cloud, folder / f"cloud.{'hdr' if name == 'envi' else name}", name)


# ---- what no check foresaw ----------------------------------------------------------------------------


def test_what_a_library_raises_in_a_stage_is_told_in_our_words() -> None:
    clock = Clock(lambda stage, share: None, lambda: False)
    with pytest.raises(StageFailedError) as failed, clock.stage("adjust"):
        raise RuntimeError("\x1b[1;31m[Open3D Error] /some/path")
    assert failed.value.details == {"stage": "adjust", "cause": "RuntimeError"}
    assert "\x1b" not in str(failed.value)
    assert "/some/path" not in str(failed.value)
    assert "millimetres" in failed.value.advice
    with pytest.raises(MemoryExhaustedError), clock.stage("register"):
        raise MemoryError
    with pytest.raises(FileNotFoundError), clock.stage("register"):
        raise FileNotFoundError

"""Depth maps to one mesh: truncated signed distances fused in a sparse voxel grid (Curless and Levoy 1996)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from specimap_core.arrays import Floats
from specimap_core.errors import DepthNotFoundError
from specimap_core.geometry.cameras import Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.native import open3d
from specimap_core.surface.settings import SurfaceSettings

BLOCK_VOXELS = 8
"""Edge of a block of voxels: 16 touch twice the memory and time for the same surface."""
FIRST_BLOCKS = 16_000
NEAREST_MM = 1.0
"""Depth from which on it counts: no lens is nearer."""


@dataclass(frozen=True)
class Mesh:
    """Triangles in the marker frame: vertices (V, 3) mm float32, triangles (T, 3) int32, normals (V, 3) unit
    outward, colours (V, 3) sRGB uint8."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    normals: NDArray[np.float32]
    colours: NDArray[np.uint8]


def fuse(
    maps: list[DepthMap],
    poses: tuple[Pose, ...],
    voxel_mm: float,
    settings: SurfaceSettings,
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Mesh:
    """Fuse depth maps seen from ``poses`` (``cam_from_world`` of the photos they belong to) at ``voxel_mm``.

    Raises:
        DepthNotFoundError: the maps hold no depth, or no voxel is seen often enough.
    """
    o3d = open3d()
    core = o3d.core
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (core.float32, core.float32, core.float32),
        ((1,), (1,), (3,)),
        voxel_mm,
        BLOCK_VOXELS,
        FIRST_BLOCKS,
        core.Device("CPU:0"),
    )
    for done, depth_map in enumerate(map(_with_known_depth, maps), 1):
        view = depth_map.view(poses[depth_map.photo])
        depth = o3d.t.geometry.Image(np.ascontiguousarray(depth_map.depth))
        colour = o3d.t.geometry.Image(depth_map.colour.astype(np.float32) / 255)
        K = core.Tensor(view.intrinsics.matrix)
        T = core.Tensor(view.cam_from_world.matrix)
        far = float(depth_map.depth.max()) + 1.0
        try:
            blocks = grid.compute_unique_block_coordinates(depth, K, T, NEAREST_MM, far, settings.truncation_voxels)
        except RuntimeError as error:
            # Of every fourth pixel, which is what Open3D looks at, none has depth.
            if "No block is touched" not in str(error):
                raise
            continue
        grid.integrate(blocks, depth, colour, K, K, T, NEAREST_MM, far, settings.truncation_voxels)
        progress(done / len(maps))
    # Of a grid without a block Open3D extracts nothing but an exception of its own.
    mesh = grid.extract_triangle_mesh(settings.least_weight) if grid.hashmap().size() else None
    if mesh is None or "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
        raise DepthNotFoundError(
            f"{len(maps)} pairs of photos gave depth, but they agree on no surface.",
            advice="Leave specimen and markers unmoved between photos, which are best 10 to 20 degrees apart.",
            maps=len(maps),
        )
    vertices = mesh.vertex.positions.numpy()
    triangles = mesh.triangle.indices.numpy().astype(np.int32)
    colours = np.clip(mesh.vertex.colors.numpy() * 255, 0, 255).astype(np.uint8)
    vertices, triangles, colours = _largest_parts(vertices, triangles, colours, settings.smallest_part_share)
    vertices, triangles, colours = _in_order(vertices, triangles, colours)
    return Mesh(vertices, triangles, vertex_normals(vertices, triangles), colours)


def _with_known_depth(depth_map: DepthMap) -> DepthMap:
    depth = depth_map.depth
    return replace(depth_map, depth=np.where(np.isfinite(depth) & (depth > NEAREST_MM), depth, np.float32(0)))


def _in_order(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], colours: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]:
    """Vertices by place, triangles by vertices: threads leave the order open, and sums follow it in their last bits."""
    order = np.lexsort(vertices.T)
    new_index = np.empty(len(order), np.int32)
    new_index[order] = np.arange(len(order), dtype=np.int32)
    turned = new_index[triangles]
    turned = np.take_along_axis(turned, (turned.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    return vertices[order], turned[np.lexsort(turned.T[::-1])], colours[order]


def _largest_parts(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    colours: NDArray[np.uint8],
    smallest_share: float,
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.uint8]]:
    """Drop connected parts with fewer triangles than a share of the largest: floating specks of false depth."""
    from scipy.sparse.csgraph import connected_components

    n = len(vertices)
    a, b = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    _, part = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    of_triangle = part[triangles[:, 0]]
    sizes = np.bincount(of_triangle, minlength=part.max() + 1)
    kept = triangles[sizes[of_triangle] >= smallest_share * sizes.max()]
    used = np.zeros(n, bool)
    used[kept] = True
    new_index = np.cumsum(used) - 1
    return vertices[used], new_index[kept].astype(np.int32), colours[used]


def vertex_normals(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> NDArray[np.float32]:
    """Area-weighted unit normals (V, 3)."""
    corners: Floats = vertices.astype(float)[triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for corner in triangles.T:
        for k in range(3):
            normals[:, k] += np.bincount(corner, face[:, k], minlength=len(vertices))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / np.maximum(length, 1e-12), np.float32)

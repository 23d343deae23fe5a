"""Rays onto a mesh, by Embree (Wald et al. 2014)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.surface.fusion import Mesh

CHUNK = 1 << 18


@dataclass(frozen=True)
class Hits:
    """First hits of N rays: ``triangle`` (N,) int32, -1 for none; ``barycentric`` (N, 2) weights of the
    triangle's second and third vertex; ``xyz`` (N, 3) mm, NaN for none."""

    triangle: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    xyz: NDArray[np.float32]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(N,) whether the ray met the mesh."""
        return self.triangle >= 0


class RayCaster:
    """A mesh made ready for casting."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._scene = EmbreeScene(robust=True)
        self._triangles = TriangleMesh(
            self._scene, np.ascontiguousarray(mesh.vertices, np.float32), mesh.triangles.astype(np.int32)
        )
        # The first ray builds the tree, which threads that cast side by side must not do at once.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    @cached_property
    def _reach(self) -> tuple[Floats, float]:
        low, high = self.mesh.vertices.min(0).astype(float), self.mesh.vertices.max(0).astype(float)
        return (low + high) / 2, float(np.linalg.norm(high - low)) / 2 + 1.0

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """Cast rays; ``origins`` (3,) or (N, 3) mm, ``directions`` (N, 3) unit."""
        directions = np.asarray(directions)
        n = len(directions)
        origins = np.broadcast_to(origins, (n, 3))
        triangle = np.full(n, -1, np.int32)
        barycentric = np.zeros((n, 2), np.float32)
        centre, radius = self._reach
        for start in range(0, n, CHUNK):
            part = slice(start, min(start + CHUNK, n))
            # Embree counts in float32: starting at the mesh's hull rather than at a far camera keeps its
            # distances short and so exact to a micrometre.
            d = directions[part]
            advance = np.maximum(((centre - origins[part]) * d).sum(-1) - radius, 0)
            near = origins[part] + advance[:, None] * d
            answer = self._scene.run(near.astype(np.float32), d.astype(np.float32), output=1)
            triangle[part] = answer["primID"]
            barycentric[part, 0], barycentric[part, 1] = answer["u"], answer["v"]
        xyz = self.interpolate(self.mesh.vertices, triangle, barycentric)
        xyz[triangle < 0] = np.nan
        return Hits(triangle, barycentric, xyz)

    def interpolate(
        self, values: NDArray[np.float32], triangle: NDArray[np.int32], barycentric: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Values per vertex (V, C) at hits, (N, C) float32; rows without a hit are those of the last triangle."""
        corner = self.mesh.triangles[triangle]
        u, v = barycentric[:, :1], barycentric[:, 1:]
        out = values[corner[:, 0]] * (1 - u - v) + values[corner[:, 1]] * u + values[corner[:, 2]] * v
        return np.asarray(out, np.float32)

    def normals(self, hits: Hits) -> NDArray[np.float32]:
        """Smooth unit normals (N, 3) at hits; NaN for none."""
        normals = self.interpolate(self.mesh.normals, hits.triangle, hits.barycentric)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        normals[~hits.hit] = np.nan
        return normals

    def colours(self, hits: Hits) -> NDArray[np.uint8]:
        """sRGB (N, 3) at hits; 0 for none."""
        rgb = self.interpolate(self.mesh.colours.astype(np.float32), hits.triangle, hits.barycentric)
        rgb[~hits.hit] = 0
        return np.asarray(np.clip(rgb + 0.5, 0, 255), np.uint8)

"""What each stage leaves on disk for the next ones."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from itertools import starmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.notices import Notice
from specimap_core.photos.reading import Refusal
from specimap_core.pipeline.artefact_store import Store
from specimap_core.reconstruct.backend import CornersInPhotos, Reconstruction
from specimap_core.render.orthographic import Grid
from specimap_core.surface.fusion import Mesh

DEPTH_STEPS = 65534
GRIDS = ("coarse", "fine")
IMAGES = ("depth_", "colour_", "confidence_", "turn_")
"""Arrays of stage 1 that stage 2 alone needs: hundreds of megabytes. Stage 4 checks its result on the greys."""


@dataclass(frozen=True)
class Stage1:
    """Reconstruction with the corners it was made from, the photos' names, and the posed photos in grey (H, W).

    ``sheet``: small tiles of the posed photos, a JPEG; empty in artefacts of versions that made none.
    """

    reconstruction: Reconstruction
    corners: CornersInPhotos
    names: tuple[str, ...]
    refused: tuple[Refusal, ...]
    subject_mm: float | None
    greys: tuple[NDArray[np.uint8], ...]
    sheet: bytes = b""

    def without_depth(self) -> Stage1:
        """The same without depth maps, for what comes after the mesh."""
        return replace(self, reconstruction=replace(self.reconstruction, maps=()))


@dataclass(frozen=True)
class Stage2:
    """Adjusted cameras, the mesh and the standard deviation of its vertices."""

    adjusted: Adjusted
    mesh: Mesh
    sigma_mm: Floats


def _poses(poses: tuple[Pose, ...]) -> np.ndarray[Any, Any]:
    return np.stack([p.matrix[:3] for p in poses])


def _poses_of(matrices: np.ndarray[Any, Any]) -> tuple[Pose, ...]:
    return tuple(Pose(m[:, :3].copy(), m[:, 3].copy()) for m in matrices)


def save_stage1(store: Store, key: str, stage: Stage1) -> None:
    """Depth is kept in 65534 steps between a map's nearest and farthest: about 2 micrometres."""
    r, c = stage.reconstruction, stage.corners
    arrays: dict[str, np.ndarray[Any, Any]] = {
        "poses": _poses(r.poses),
        "points": r.points,
        "seen_photo": c.seen.photo,
        "seen_marker": c.seen.marker,
        "seen_corners": c.seen.corners_px,
        "seen_sigma": c.seen.sigma_px,
        "greys": np.stack(stage.greys),
        "sheet": np.frombuffer(stage.sheet, np.uint8),
    }
    maps_meta = []
    for k, m in enumerate(r.maps):
        known = m.depth > 0
        low = float(m.depth[known].min()) if known.any() else 0.0
        step = max((float(m.depth.max()) - low) / DEPTH_STEPS, 1e-9)
        packed = np.where(known, np.round((m.depth - low) / step) + 1, 0).astype(np.uint16)
        arrays |= {f"depth_{k}": packed, f"colour_{k}": m.colour, f"turn_{k}": m.turn}
        arrays[f"confidence_{k}"] = m.confidence
        maps_meta.append({"photo": m.photo, "low": low, "step": step, "lens": asdict(m.intrinsics)})
    meta = {
        "photos": r.photos,
        "lens": asdict(r.lens),
        "maps": maps_meta,
        "names": stage.names,
        "refused": [asdict(x) for x in stage.refused],
        "refused_later": [asdict(x) for x in r.refused],
        "remarks": [(warning.code, warning.message) for warning in r.warnings],
        "marker_ids": c.marker_ids,
        "subject_mm": stage.subject_mm,
    }
    store.save("reconstruct", key, arrays, meta)


def load_stage1(store: Store, key: str, *, with_depth: bool = True) -> Stage1 | None:
    """The artefact of :func:`save_stage1`; without depth maps where only what follows needs it."""
    found = store.load("reconstruct", key, () if with_depth else IMAGES)
    if found is None:
        return None
    arrays, meta = found
    maps = []
    for k, m in enumerate(meta["maps"] if with_depth else []):
        packed = arrays[f"depth_{k}"]
        depth = np.where(packed > 0, (packed.astype(np.float32) - 1) * m["step"] + m["low"], 0).astype(np.float32)
        lens = Intrinsics(**m["lens"])
        maps.append(
            DepthMap(m["photo"], arrays[f"turn_{k}"], lens, depth, arrays[f"confidence_{k}"], arrays[f"colour_{k}"])
        )
    reconstruction = Reconstruction(
        tuple(meta["photos"]),
        Intrinsics(**meta["lens"]),
        _poses_of(arrays["poses"]),
        tuple(maps),
        arrays["points"],
        tuple(Refusal(**x) for x in meta["refused_later"]),
        tuple(starmap(Notice, meta["remarks"])),
    )
    seen = Observations(arrays["seen_photo"], arrays["seen_marker"], arrays["seen_corners"], arrays["seen_sigma"])
    return Stage1(
        reconstruction,
        CornersInPhotos(seen, tuple(meta["marker_ids"])),
        tuple(meta["names"]),
        tuple(Refusal(**x) for x in meta["refused"]),
        meta["subject_mm"],
        tuple(arrays.get("greys", ())),
        bytes(arrays.get("sheet", b"")),
    )


def save_stage2(store: Store, key: str, stage: Stage2) -> None:
    """Cameras, corners with covariance, mesh."""
    a, mesh = stage.adjusted, stage.mesh
    arrays = {
        "poses": _poses(a.poses),
        "corners": a.corners,
        "covariance": a.covariance,
        "vertices": mesh.vertices,
        "triangles": mesh.triangles,
        "normals": mesh.normals,
        "colours": mesh.colours,
        "sigma": stage.sigma_mm,
    }
    meta = {
        "lens": asdict(a.lens),
        "marker_ids": a.marker_ids,
        "scale": a.scale,
        "rms": [a.rms_before_px, a.rms_after_px],
        "iterations": a.iterations,
        "observations": a.observations,
    }
    store.save("adjust", key, arrays, meta)


def load_stage2(store: Store, key: str) -> Stage2 | None:
    """The artefact of :func:`save_stage2`."""
    found = store.load("adjust", key)
    if found is None:
        return None
    x, meta = found
    adjusted = Adjusted(
        Intrinsics(**meta["lens"]),
        _poses_of(x["poses"]),
        tuple(meta["marker_ids"]),
        x["corners"],
        x["covariance"],
        meta["scale"],
        meta["rms"][0],
        meta["rms"][1],
        meta["iterations"],
        meta["observations"],
    )
    return Stage2(adjusted, Mesh(x["vertices"], x["triangles"], x["normals"], x["colours"]), x["sigma"])


def save_grids(store: Store, key: str, grids: tuple[Grid, Grid], mesh: Mesh) -> None:
    """Coarse and fine grid of a mesh."""
    arrays = {
        f"{name}_{field}": getattr(grid, field)
        for name, grid in zip(GRIDS, grids, strict=True)
        for field in ("image", "xyz", "normal", "covered")
    }
    places = [[g.cell_mm, g.x_min, g.y_min] for g in grids]
    store.save("render", key, arrays, {"mesh": _digest(mesh), "grids": places})


def load_grids(store: Store, key: str, mesh: Mesh) -> tuple[Grid, Grid] | None:
    """The artefact of :func:`save_grids`, if it is of this very mesh: a mesh made anew differs in its last digits."""
    found = store.load("render", key)
    if found is None or found[1]["mesh"] != _digest(mesh):
        return None
    x, meta = found
    coarse, fine = (
        Grid(cell, x_min, y_min, x[f"{name}_image"], x[f"{name}_xyz"], x[f"{name}_normal"], x[f"{name}_covered"])
        for name, (cell, x_min, y_min) in zip(GRIDS, meta["grids"], strict=True)
    )
    return coarse, fine


def _digest(mesh: Mesh) -> str:
    return hashlib.sha256(mesh.vertices.tobytes()).hexdigest()

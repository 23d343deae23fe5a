"""The exact truth about a phantom, and its file ``truth.npz``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from specimap_core.arrays import Array, Floats
from specimap_core.atomic import atomic_path
from specimap_core.errors import NotFoundError
from specimap_core.geometry.cameras import Intrinsics, Pose, View
from specimap_core.geometry.pushbroom import Axis, ScanView, WobblyScan


def _no_vertices() -> Floats:
    return np.empty((0, 3))


def _no_triangles() -> NDArray[np.int32]:
    return np.empty((0, 3), np.int32)


@dataclass(frozen=True)
class Truth:
    """Exact geometry and spectra of a phantom. World: mm, z up, the cards' nominal plane at z = 0."""

    marker_ids: NDArray[np.int64]
    """(N,)"""
    marker_corners: Floats
    """(N, 4, 3) mm: top-left, top-right, bottom-right, bottom-left of the upright marker."""
    edge_mm: float
    views: list[View]
    photo_names: list[str]
    """Relative to the phantom's folder."""
    hsi_view: View
    """A :class:`~specimap_core.geometry.pushbroom.ScanView` where the cube's camera is a push-broom."""
    hsi_xyz: NDArray[np.float32]
    """(H, W, 3) mm: first hit of the ray through each cube pixel's centre; NaN if none.

    Where the specimen moved between photos and cube, the ray meets the moved specimen, and what stands here is
    where that tissue lay in the photos: the place that its spectrum belongs to. ``vertices`` are as in the photos.
    """
    hsi_class: NDArray[np.uint8]
    """(H, W): 0 none, 1 specimen, 2 marker card, 3 tray, 4 bench."""
    abundance: NDArray[np.float32]
    """(H, W, M), sums to 1 wherever something is hit."""
    endmembers: Floats
    """(M, B) reflectance."""
    wavelengths_nm: Floats
    """(B,)"""
    materials: tuple[str, ...]
    bad_bands: NDArray[np.int64]
    """Indices of bands that hold only noise."""
    dead_pixels: NDArray[np.int64]
    """(D, 2) row, column of pixels without a signal."""
    vertices: Floats = field(default_factory=_no_vertices)
    """(V, 3) mm of the specimen's mesh; empty where the file does not hold it."""
    triangles: NDArray[np.int32] = field(default_factory=_no_triangles)


def save_truth(truth: Truth, path: Path) -> None:
    """Write ``truth.npz`` atomically."""
    h, w = truth.hsi_class.shape
    arrays: dict[str, Array] = {
        "marker_ids": truth.marker_ids,
        "marker_corners": truth.marker_corners,
        "marker_length": np.array(truth.edge_mm),
        "rgb_K": np.stack([v.intrinsics.matrix for v in truth.views]),
        "rgb_R": np.stack([v.cam_from_world.R for v in truth.views]),
        "rgb_t": np.stack([v.cam_from_world.t for v in truth.views]),
        "rgb_dist": np.stack([[v.intrinsics.k1, v.intrinsics.k2, 0, 0, 0] for v in truth.views]),
        "rgb_size": np.array([(v.intrinsics.width, v.intrinsics.height) for v in truth.views]),
        "rgb_files": np.array(truth.photo_names),
        "hsi_K": truth.hsi_view.intrinsics.matrix,
        "hsi_R": truth.hsi_view.cam_from_world.R,
        "hsi_t": truth.hsi_view.cam_from_world.t,
        "hsi_dist": np.append(truth.hsi_view.intrinsics.distortion, 0.0),
        "hsi_size": np.array([w, h]),
        **_scan_arrays(truth.hsi_view),
        "hsi_xyz": truth.hsi_xyz,
        "hsi_class": truth.hsi_class,
        "hsi_abundance": truth.abundance.astype(np.float16),
        "materials": np.array(truth.materials),
        "endmembers": truth.endmembers,
        "wavelengths": truth.wavelengths_nm,
        "bad_bands": truth.bad_bands,
        "dead_pixels": truth.dead_pixels,
        "mesh_vertices": truth.vertices.astype(np.float32),
        "mesh_triangles": truth.triangles,
    }
    with atomic_path(path) as aside, open(aside, "wb") as f:
        np.savez_compressed(f, allow_pickle=False, **arrays)


def load_truth(path: Path) -> Truth:
    """Read a phantom's ``truth.npz``, or that of the folder ``path``.

    Raises ``NotFoundError`` if the file is not there or is none, or says no photo size and has no photo next to it.
    """
    file = path / "truth.npz" if path.is_dir() else path
    if not file.is_file():
        raise NotFoundError(f"There is no {file}.", advice="Give a phantom's folder or its truth.npz.")
    try:
        return _read(file)
    except (ValueError, KeyError, EOFError, BadZipFile) as error:
        raise NotFoundError(
            f"{file} is not a phantom's truth.", advice="Give a phantom's folder or its truth.npz."
        ) from error


def _read(file: Path) -> Truth:
    with open(file, "rb") as f, np.load(f, allow_pickle=False) as z:  # a damaged file is closed, too
        names = [str(n) for n in z["rgb_files"]]
        sizes = z["rgb_size"] if "rgb_size" in z else [_photo_size(file.parent / n) for n in names]
        views = [_view(*row) for row in zip(z["rgb_K"], z["rgb_R"], z["rgb_t"], z["rgb_dist"], sizes, strict=True)]
        has_mesh = "mesh_vertices" in z
        return Truth(
            marker_ids=z["marker_ids"],
            marker_corners=z["marker_corners"],
            edge_mm=float(z["marker_length"]),
            views=views,
            photo_names=names,
            hsi_view=_scanned(_view(z["hsi_K"], z["hsi_R"], z["hsi_t"], z["hsi_dist"], z["hsi_size"]), z),
            hsi_xyz=z["hsi_xyz"],
            hsi_class=z["hsi_class"],
            abundance=z["hsi_abundance"].astype(np.float32),
            endmembers=z["endmembers"],
            wavelengths_nm=z["wavelengths"],
            materials=tuple(str(m) for m in z["materials"]),
            bad_bands=z["bad_bands"],
            dead_pixels=z["dead_pixels"],
            vertices=z["mesh_vertices"].astype(float) if has_mesh else _no_vertices(),
            triangles=z["mesh_triangles"] if has_mesh else _no_triangles(),
        )


def _view(K: Floats, R: Floats, t: Floats, dist: Floats, size: NDArray[np.int64] | tuple[int, int]) -> View:
    width, height = (int(s) for s in size)
    lens = Intrinsics(
        width,
        height,
        float(K[0, 0]),
        float(K[0, 2]),
        float(K[1, 2]),
        float(dist[0]),
        float(dist[1]),
        aspect=float(K[0, 0] / K[1, 1]),
    )
    return View(lens, Pose(R, t))


def _scan_arrays(view: View) -> dict[str, Array]:
    """What a push-broom camera has beyond a lens and a pose; nothing for a frame camera."""
    if not isinstance(view, ScanView):
        return {}
    wobble = view.wobble_mm if isinstance(view, WobblyScan) else 0.0
    return {
        "hsi_scan": np.array(view.scan),
        "hsi_scan_motion": np.array([view.skew, view.climb, view.depth_mm, wobble]),
    }


def _scanned(view: View, stored: Mapping[str, Array]) -> View:
    """The inverse of :func:`_scan_arrays`."""
    if "hsi_scan" not in stored:
        return view
    axis: Axis = "rows" if str(stored["hsi_scan"]) == "rows" else "columns"
    skew, climb, depth, wobble = (float(v) for v in stored["hsi_scan_motion"])
    scan = view.intrinsics, view.cam_from_world, axis, skew, climb, depth
    return WobblyScan(*scan, wobble) if wobble else ScanView(*scan)


def _photo_size(photo: Path) -> tuple[int, int]:
    if not photo.is_file():
        raise NotFoundError(
            f"The truth says no photo size, and {photo} is not there.",
            advice="Keep the photos beside truth.npz.",
        )
    with Image.open(photo) as image:
        return image.size

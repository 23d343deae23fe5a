"""COLMAP's PatchMatch over photos whose cameras are known; run by :mod:`specimap_core.reconstruct.dense.patchmatch` in
a process of its own, see :mod:`specimap_core.sandbox.child`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

STEP = "depth"
WATCH_SECONDS = 0.5
KINDS = ("photometric", "geometric")
"""COLMAP goes over all photos twice: by appearance alone, then with the depths of the others."""


def image_name(photo: int) -> str:
    """The photo's file in the workspace."""
    return f"{photo:05d}.png"


def depth_file(folder: Path, photo: int, kind: str = "geometric") -> Path:
    """Where COLMAP leaves a photo's depth."""
    return folder / "stereo" / "depth_maps" / f"{image_name(photo)}.{kind}.bin"


def write_workspace(
    folder: Path,
    images: NDArray[np.uint8],
    pinhole: NDArray[np.float64],
    R: NDArray[np.float64],
    t: NDArray[np.float64],
    sources: list[list[int]],
) -> None:
    """Write a dense workspace as COLMAP reads it.

    ``images`` (N, H, W, 3) undistorted; ``pinhole`` (3,): focal length and principal point, px, pixel centres at
    integers; ``R`` (N, 3, 3), ``t`` (N, 3) mm: ``cam_from_world``; ``sources``: each photo's partners.

    Every photo is a reference, since geometric consistency needs the depth of all sources. The principal point is
    left as OpenCV counts it: unlike the rest of COLMAP, PatchMatch takes a pixel's column and row for its coordinates,
    so that half a pixel added here would bend all rays by as much.
    """
    for part in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    focal, cx, cy = (float(v) for v in pinhole)
    height, width = images.shape[1:3]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[focal, focal, cx, cy], camera_id=1)
    )
    lines = []
    for k, others in enumerate(sources):
        pycolmap.Bitmap.from_array(np.ascontiguousarray(images[k])).write(folder / "images" / image_name(k))
        image = pycolmap.Image(name=image_name(k), camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R[k]), t[k]))
        lines += [image_name(k), ", ".join(image_name(j) for j in others)]
    model.write(folder / "sparse")
    (folder / "stereo" / "patch-match.cfg").write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_depth(file: Path) -> NDArray[np.float32]:
    """A depth map of COLMAP's, (H, W), 0 where unknown."""
    found = pycolmap.DepthMap()
    found.read(file)
    depth = np.asarray(found.to_array(), np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def run(
    request: dict[str, Any], arrays: dict[str, Any], step: Callable[[str, float], None]
) -> tuple[dict[str, NDArray[np.float32]], dict[str, object]]:
    """Depths (N, H, W) mm, 0 where unknown, of the photos in ``arrays``."""
    folder = Path(request["folder"]) / "dense"
    photos = len(arrays["images"])
    write_workspace(folder, arrays["images"], arrays["pinhole"], arrays["R"], arrays["t"], request["sources"])
    options = pycolmap.PatchMatchOptions()
    options.depth_min, options.depth_max = request["depth_mm"]
    options.geom_consistency = True
    options.filter = True
    done = threading.Event()

    def watch() -> None:
        while not done.wait(WATCH_SECONDS):
            step(STEP, len(list(depth_file(folder, 0).parent.glob("*.bin"))) / (len(KINDS) * photos))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        pycolmap.patch_match_stereo(folder, options=options)
    finally:
        done.set()
        watcher.join()
    return {"depth": np.stack([read_depth(depth_file(folder, k)) for k in range(photos)])}, {"photos": photos}

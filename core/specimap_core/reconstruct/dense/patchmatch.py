"""Dense depth on a GPU: COLMAP's PatchMatch (Schoenberger et al. 2016) over photos whose cameras are known.

The photos are undistorted; COLMAP gets our poses in mm and each photo's partners, so that it needs no sparse points,
and searches depth over the volume above the markers. It runs in a process of its own, which can be stopped any time.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.errors import BackendFailedError, BackendUnavailableError, DepthNotFoundError
from specimap_core.geometry.cameras import Intrinsics, Pose, View
from specimap_core.geometry.depth_map import DepthMap, cropped_map
from specimap_core.notices import Notice, Notices
from specimap_core.reconstruct.dense.cross_check import confirmed, nearest_photos, share_confirmed
from specimap_core.reconstruct.dense.device import DENSE_DEVICE
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import Volume, inside_volume
from specimap_core.sandbox.process import run_child

CHILD = Path(__file__).with_name("patchmatch_child.py")
SOURCES = 8
"""Partners of a photo at most; COLMAP weighs them pixel by pixel, so that more cost time alone."""
LEAST_SOURCES = 2
CONFIRMING = 3
"""Photos whose depth is compared for the confidence."""
TOLERANCE = 0.005
"""Share of the depth by which two photos' depths may differ: about one pixel at 15 degrees between them."""
DEPTH_MARGIN = 0.02

DENSE_ON_GPU = Notice("dense_on_gpu", "Depth was measured on a GPU by COLMAP's PatchMatch.")

Progress = Callable[[float], None]


def cuda_devices() -> int:
    """CUDA devices in sight of this process, asked of the driver; 0 without one."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value


def what_is_missing() -> str | None:
    """Why PatchMatch cannot run here, in a sentence; None where it can."""
    if not pycolmap.has_cuda:
        return "The installed pycolmap is built without CUDA."
    if cuda_devices() == 0:
        return "No CUDA device is in sight."
    return None


def check_device(settings: DepthSettings) -> None:
    """Refuse a GPU that is asked for and not to be had.

    Raises:
        BackendUnavailableError: PatchMatch cannot run on one here.
    """
    missing = what_is_missing() if settings.device == "gpu" else None
    if missing is not None:
        raise BackendUnavailableError(
            f"{DENSE_DEVICE} asks for dense stereo on a GPU. {missing}",
            advice="Install pycolmap-cuda12 in place of pycolmap on a machine with an NVIDIA GPU (docs/backends.md), "
            "or choose the CPU; auto takes a GPU only where there is one.",
            missing=missing,
        )


def measure_depth(
    images: list[Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    volume: Volume,
    settings: DepthSettings,
    *,
    workers: int,
    progress: Progress,
) -> tuple[list[DepthMap], Notices]:
    """Depth maps on the device that the settings name, and warnings for the report.

    ``auto`` takes a GPU where PatchMatch can run, and the CPU where it cannot or fails.

    Raises:
        BackendUnavailableError: a GPU is asked for, and PatchMatch cannot run on one here.
        BackendFailedError, DepthNotFoundError: a GPU is asked for, and PatchMatch failed or gave nothing.
    """
    missing = "" if settings.device == "cpu" else what_is_missing()
    if missing is not None:
        check_device(settings)
    warnings: Notices = ()
    reached = 0.0

    def forward(share: float) -> None:
        nonlocal reached
        reached = max(reached, share)
        progress(reached)

    if missing is None:
        try:
            maps = patchmatch_depth(images, lens, poses, volume, settings, workers=workers, progress=forward)
        except (BackendFailedError, DepthNotFoundError) as error:
            if settings.device == "gpu":
                raise
            warnings = (
                Notice("dense_gpu_failed", f"Depth was measured on the CPU, since the GPU failed: {error.message}"),
            )
        else:
            return maps, (DENSE_ON_GPU,)
    return dense_depth(images, lens, poses, volume, settings, workers=workers, progress=forward), warnings


def patchmatch_depth(
    images: list[Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    volume: Volume,
    settings: DepthSettings,
    *,
    workers: int,
    progress: Progress = lambda share: None,
    child: Path = CHILD,
) -> list[DepthMap]:
    """Depth maps, one a photo at most, of posed ``images`` (H, W, 3), in undistorted cameras at the photos' places.

    Raises:
        BackendFailedError: COLMAP failed on the GPU; details hold its last lines.
        DepthNotFoundError: no photo got depth.
    """
    plain = pinhole(lens)
    straight = undistorted(images, lens)
    answer = run_child(
        child,
        {"sources": choose_sources(poses, volume.centre, settings), "depth_mm": depth_range(poses, volume)},
        {
            "images": straight,
            "pinhole": np.array([plain.focal_px, plain.cx, plain.cy]),
            "R": np.stack([p.R for p in poses]),
            "t": np.stack([p.t for p in poses]),
        },
        name="patchmatch",
        steps={"depth": 1.0},
        progress=lambda share: progress(0.95 * share),
    )
    maps = maps_of(answer.arrays["depth"], straight, plain, poses, volume, workers=workers)
    if not maps:
        raise DepthNotFoundError(
            "PatchMatch found no depth in the volume over the markers.",
            advice="Take photos that overlap: neighbours 10 to 20 degrees apart, the specimen sharp and lit evenly.",
        )
    progress(1.0)
    return maps


def pinhole(lens: Intrinsics) -> Intrinsics:
    """The same camera without distortion."""
    return replace(lens, k1=0.0, k2=0.0)


def undistorted(images: list[Bytes], lens: Intrinsics) -> Bytes:
    """The photos (N, H, W, 3) as :func:`pinhole` sees them; black where the lens saw nothing."""
    plain = pinhole(lens)
    maps = cv2.initUndistortRectifyMap(
        lens.matrix, lens.distortion, np.eye(3), plain.matrix, (plain.width, plain.height), cv2.CV_32FC1
    )
    return np.stack(
        [np.asarray(cv2.remap(i, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT), np.uint8) for i in images]
    )


def choose_sources(poses: tuple[Pose, ...], target: Floats, settings: DepthSettings) -> list[list[int]]:
    """For each photo its partners, best first; where too few look from a fitting angle, the nearest."""
    many = replace(settings, pairs_per_photo=SOURCES, many_photos=len(poses) + 1)
    sources: list[list[int]] = [[] for _ in poses]
    for i, j in choose_pairs(poses, target, many):
        sources[i].append(j)
    nearest = nearest_photos(poses, target, LEAST_SOURCES)
    return [
        own if len(own) >= LEAST_SOURCES else list(dict.fromkeys([*own, *near]))[:LEAST_SOURCES]
        for own, near in zip(sources, nearest, strict=True)
    ]


def depth_range(poses: tuple[Pose, ...], volume: Volume) -> tuple[float, float]:
    """Nearest and farthest depth of the volume in any of the cameras, with a little room, mm."""
    depth = np.stack([p.apply(volume.vertices)[:, 2] for p in poses])
    far = float(depth.max()) * (1 + DEPTH_MARGIN)
    return max(float(depth.min()) * (1 - DEPTH_MARGIN), 0.02 * far), far


def maps_of(
    depths: Singles, colours: Bytes, lens: Intrinsics, poses: tuple[Pose, ...], volume: Volume, *, workers: int
) -> list[DepthMap]:
    """Depths (N, H, W) of all photos, cut to the volume.

    The confidence grows with the share of neighbouring photos that see a depth and confirm it.
    """
    inside = [inside_volume(d, lens, p.R, p, volume) for d, p in zip(depths, poses, strict=True)]
    others = nearest_photos(poses, volume.centre, CONFIRMING)
    checked = confirmed(inside, [View(lens, pose) for pose in poses], others, TOLERANCE, workers=workers)
    maps = []
    for photo, (depth, (seen, agreed)) in enumerate(zip(inside, checked, strict=True)):
        confidence = np.rint(255 * share_confirmed(seen, agreed)).astype(np.uint8)
        found = cropped_map(photo, np.eye(3), lens, depth, colours[photo], confidence)
        if found is not None:
            maps.append(found)
    return maps

"""Cameras of the phantom: photos on rings around the specimen, the cube's camera above it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at, rotation_from_vector
from specimap_core.geometry.pushbroom import ScanView, WobblyScan
from specimap_validation.phantom.settings import PhantomSettings, Stream

_TOP_SHARE = 1 / 6
_TWO_RINGS_FROM = 14  # below this, one ring keeps neighbours close enough for stereo
_DESIGN_SCENE_MM = 31.2  # ``distance_mm`` frames a scene of this radius


def photo_views(settings: PhantomSettings) -> list[View]:
    """Cameras at elevations of 30 to 65 degrees and all azimuths, and a sixth of them near top-down."""
    rng = settings.rng(Stream.CAMERAS)
    return [_photo_view(settings, rng, *angles) for angles in _angles(settings.photos, rng)]


def _angles(count: int, rng: np.random.Generator) -> list[tuple[float, float]]:
    """(azimuth, elevation) rad of each photo, ring by ring."""
    top = round(count * _TOP_SHARE)
    around = count - top
    if around < _TWO_RINGS_FROM:
        rings = [(around, 45.0, 10.0)]
    else:
        low = (around + 1) // 2
        rings = [(low, 36.0, 4.0), (around - low, 56.0, 5.0)]
    angles = []
    for n, elevation, swing in [*rings, (top, 74.0, 4.0)]:
        start, phase = rng.uniform(0, 2 * np.pi, 2)
        for k in range(n):
            azimuth = start + 2 * np.pi * (k + rng.uniform(-0.12, 0.12)) / n
            wave = swing * np.sin(2 * azimuth + phase) + rng.uniform(-1, 1)
            angles.append((azimuth, np.radians(elevation + wave)))
    return angles


def _photo_view(settings: PhantomSettings, rng: np.random.Generator, azimuth: float, elevation: float) -> View:
    farther = settings.scene_mm / _DESIGN_SCENE_MM
    distance = settings.distance_mm * farther * rng.uniform(0.93, 1.04)
    direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    target = np.array([0, 0, 2.0]) + rng.uniform(-1.5, 1.5, 3) * farther
    pose = look_at(target + distance * direction, target, np.array([0.0, 0, 1]))
    roll = Pose(_roll(np.radians(rng.uniform(-6, 6))), np.zeros(3))
    focal = settings.focal_factor * settings.photo_size * (1 + settings.focal_spread * rng.standard_normal())
    lens = Intrinsics.centred(settings.photo_size, settings.photo_size, focal, settings.k1, settings.k2)
    return View(lens, roll @ pose)


def hsi_view(settings: PhantomSettings) -> View:
    """The cube's camera above the tray, slightly tilted, framing specimen and cards."""
    rng = np.random.default_rng([settings.seed, Stream.CUBE, 1])
    # The shorter side in widths of a pixel frames the scene.
    shorter = min(settings.cube_rows * settings.cube_aspect, settings.cube_cols)
    focal = shorter * settings.hsi_distance_mm / (2.12 * settings.scene_mm)
    lens = Intrinsics.centred(settings.cube_cols, settings.cube_rows, focal, settings.cube_k1)
    lens = replace(lens, aspect=settings.cube_aspect)
    around = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(settings.hsi_tilt_deg) * np.array([np.cos(around), np.sin(around), 0])
    down = np.diag([1.0, -1.0, -1.0]) @ rotation_from_vector(tilt)
    if settings.cube_scan == "none":
        eye = -settings.hsi_distance_mm * down[2]
        R = _roll(np.radians(settings.cube_rotation_deg)) @ down
        return View(lens, Pose(R, -R @ eye))
    rows = settings.cube_scan == "rows"
    R = _roll(np.radians(settings.cube_rotation_deg)) @ down
    pitch = np.radians(settings.scan_pitch_deg)
    R = rotation_from_vector(pitch * np.array([1.0, 0, 0] if rows else [0, -1.0, 0])) @ R
    eye = -settings.hsi_distance_mm * R[2]
    pose = Pose(R, -R @ eye)
    line, across = (0, 1) if rows else (1, 0)
    # A level stage: what the camera's own axes climb, its motion along z takes back.
    climb = -(R[across, 2] + settings.scan_skew * R[line, 2]) / R[2, 2]
    where = ScanView if not settings.scan_wobble_mm else partial(WobblyScan, wobble_mm=settings.scan_wobble_mm)
    return where(lens, pose, settings.cube_scan, settings.scan_skew, float(climb), settings.hsi_distance_mm)


def _roll(angle: float) -> Floats:
    return rotation_from_vector(np.array([0, 0, angle]))

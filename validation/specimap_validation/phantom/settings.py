"""Settings of a phantom: one frozen dataclass, checked when it is built."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np

from specimap_core.errors import SettingsError

_ADVICE = "Give a value within the stated range."
_MOST_TILT_DEG = 20.0
_LEAST: dict[str, float] = {
    "seed": 0,
    "mesh_divisions": 4,
    "texture_contrast": 0,
    "gloss": 0,
    "edge_mm": 0.1,
    "card_tilt_deg": 0,
    "card_lift_mm": 0,
    "photos": 1,
    "photo_size": 16,
    "focal_factor": 0.3,
    "focal_spread": 0,
    "distance_mm": 60,
    "blur_px": 0,
    "exposure_spread": 0,
    "noise": 0,
    "cube_rows": 16,
    "cube_cols": 16,
    "bands": 1,
    "hsi_distance_mm": 60,
    "hsi_tilt_deg": 0,
    "cube_aspect": 0.1,
    "scan_skew": -0.5,
    "scan_pitch_deg": -30,
    "scan_wobble_mm": 0,
    "cube_k1": -1,
    "cube_noise": 0,
    "bad_band_fraction": 0,
    "dead_pixel_fraction": 0,
}
_MOST: dict[str, float] = {
    "texture_contrast": 2.5,
    "card_tilt_deg": 20,
    "hsi_tilt_deg": 20,
    "focal_spread": 0.1,
    "cube_aspect": 10,
    "scan_skew": 0.5,
    "scan_pitch_deg": 30,
    "scan_wobble_mm": 2,
    "cube_k1": 1,
    "bad_band_fraction": 0.5,
    "dead_pixel_fraction": 0.5,
}


class Stream(IntEnum):
    """Independent random streams, so that a change of one part leaves the others as they were."""

    SHAPE = 0
    CARDS = 1
    CAMERAS = 2
    DETAIL = 3
    CUBE = 4
    PHOTO = 5
    TRAY = 6


def check_ranges(settings: object, least: dict[str, float], most: dict[str, float]) -> None:
    """Refuse fields of ``settings`` below ``least`` or above ``most``, or not numbers. Raises ``SettingsError``."""
    for name, low in least.items():
        value, high = getattr(settings, name), most.get(name, np.inf)
        if not low <= value <= high:
            raise SettingsError(f"{name} is {value}, outside [{low}, {high}].", advice=_ADVICE, setting=name)


@dataclass(frozen=True)
class PhantomSettings:
    """A phantom's recipe. The same settings give the same bytes. Raises ``SettingsError`` out of range."""

    seed: int = 1

    # ---- specimen ----
    specimen_mm: tuple[float, float, float] = (33.0, 28.0, 14.0)
    """Extent in x, y and height above the tray."""
    mesh_divisions: int = 112
    """Cells along the edge of each of the six faces of a cube sphere: 12 n^2 triangles."""
    texture_contrast: float = 1.0
    """Strength of the fine brightness detail; 0 leaves only the tissue's own colours."""
    gloss: float = 0.15
    """Strength of the view-dependent highlights on the specimen."""

    # ---- markers ----
    marker_ids: tuple[int, ...] = (0, 1, 2, 3)
    dictionary: str = "DICT_4X4_50"
    edge_mm: float = 6.8
    card_tilt_deg: float = 0.0
    """Largest tilt of a card against the tray."""
    card_lift_mm: float = 0.0
    """Largest height of a card above its place on the tray."""

    # ---- photos ----
    photos: int = 24
    photo_size: int = 512
    focal_factor: float = 1.95
    """Focal length over the photo's side."""
    focal_spread: float = 0.0
    """Relative sd of the focal length from photo to photo (focus breathing)."""
    k1: float = 0.0
    k2: float = 0.0
    distance_mm: float = 150.0
    blur_px: float = 0.0
    """Gaussian sd of the defocus."""
    exposure_spread: float = 0.0
    """Sd of the exposure in stops from photo to photo."""
    noise: float = 1.5 / 255
    """Sd of the photos' noise; encoded full scale is 1."""
    bare_photos: tuple[int, ...] = ()
    """Photos that show no card: in them the specimen lies on the tray alone."""

    # ---- cube ----
    cube_rows: int = 512
    cube_cols: int = 640
    bands: int = 64
    wavelength_nm: tuple[float, float] = (400.0, 1700.0)
    hsi_distance_mm: float = 400.0
    hsi_tilt_deg: float = 1.5
    cube_rotation_deg: float = 0.0
    """Roll of the hyperspectral camera about its optical axis."""
    cube_aspect: float = 1.0
    """Height of a cube's pixel over its width."""
    cube_scan: Literal["none", "rows", "columns"] = "none"
    """The line that a push-broom camera records at a time; ``none``: a frame camera."""
    scan_skew: float = 0.0
    """Motion along the line while the scan goes on by 1 mm: a stage that is not square to the line."""
    scan_pitch_deg: float = 0.0
    """Forward tilt of a push-broom camera that moves level."""
    scan_wobble_mm: float = 0.0
    """Amplitude by which the stage runs ahead and behind, in two periods over the whole scan."""
    cube_k1: float = 0.0
    """First radial distortion of a frame camera."""
    cube_noise: float = 0.005
    """Sd in reflectance at the best band; about four times that at both ends of the range."""
    bad_band_fraction: float = 0.0
    dead_pixel_fraction: float = 0.0

    # ---- between photos and cube ----
    moved_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift of the specimen alone, after the photos and before the cube; cards and tray stay."""
    moved_deg: float = 0.0
    """Turn of the specimen about the vertical through the middle of its base, before the shift."""
    moved_tilt_deg: float = 0.0
    """Tilt of the specimen about the x axis through the middle of its base, after the turn; the low side sinks in."""

    def __post_init__(self) -> None:
        check_ranges(self, _LEAST, _MOST)
        if not self.marker_ids or len(set(self.marker_ids)) != len(self.marker_ids):
            raise SettingsError("marker_ids must hold distinct ids.", advice="List each id once.", setting="marker_ids")
        if not set(self.bare_photos) <= set(range(self.photos)):
            raise SettingsError("bare_photos names photos that are not taken.", advice=_ADVICE, setting="bare_photos")
        if not 0 < self.wavelength_nm[0] < self.wavelength_nm[1]:
            raise SettingsError("wavelength_nm must rise.", advice="Give (first, last) in nm.", setting="wavelength_nm")
        if not np.isfinite([*self.moved_mm, self.moved_deg]).all() or not abs(self.moved_tilt_deg) <= _MOST_TILT_DEG:
            raise SettingsError(
                "The specimen's motion is not finite, or tilts it too far.", advice=_ADVICE, setting="moved_mm"
            )
        if self.cube_scan not in ("none", "rows", "columns"):
            raise SettingsError(
                f"cube_scan is {self.cube_scan}.", advice="Use none, rows or columns.", setting="cube_scan"
            )
        if min(self.specimen_mm) < 1:
            raise SettingsError("specimen_mm is below 1 mm.", advice=_ADVICE, setting="specimen_mm")

    @property
    def moved(self) -> bool:
        """Whether the cube shows the specimen elsewhere than the photos do."""
        return any((*self.moved_mm, self.moved_deg, self.moved_tilt_deg))

    @property
    def card_mm(self) -> float:
        """Side of the white card: a quiet zone of a quarter edge all around the marker."""
        return 1.5 * self.edge_mm

    @property
    def wavelengths_nm(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Band centres (B,), nm."""
        return np.linspace(*self.wavelength_nm, self.bands)

    @property
    def ring_mm(self) -> float:
        """Radius of the circle of markers: clear of the specimen and wide enough for every card."""
        diagonal = self.card_mm * 2**0.5
        clear = max(self.specimen_mm[:2]) / 2 + diagonal / 2 + 0.3
        return max(clear, 1.1 * diagonal * len(self.marker_ids) / (2 * np.pi))

    @property
    def scene_mm(self) -> float:
        """Radius of the circle that holds specimen and cards."""
        return self.ring_mm + self.card_mm / 2**0.5

    def rng(self, stream: Stream, index: int = 0) -> np.random.Generator:
        """The generator of one part of the phantom."""
        return np.random.default_rng([self.seed, stream, index])

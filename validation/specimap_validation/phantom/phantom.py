"""A phantom: its scene, photos, cube and truth, made from the settings."""

from __future__ import annotations

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import Pose, View
from specimap_core.photos.colour import srgb_from_linear
from specimap_core.truth.truth_file import Truth
from specimap_validation.phantom import materials
from specimap_validation.phantom.render import CLASS_SPECIMEN, Paint, Rendering, render_view
from specimap_validation.phantom.scene import Scene, build_scene, without_cards
from specimap_validation.phantom.settings import PhantomSettings, Stream
from specimap_validation.phantom.specimen import Specimen, displacement
from specimap_validation.phantom.views import hsi_view, photo_views

REFLECTANCE_SCALE = 10000
_CUBE_SHADING = 0.5  # a reflectance cube has most of the light's unevenness calibrated away
_THREADS = 2
_JPEG_QUALITY = 95


class Phantom:
    """A synthetic specimen with exact truth. Everything is made when first asked for, from the seed alone."""

    def __init__(self, settings: PhantomSettings | None = None) -> None:
        self.settings = settings or PhantomSettings()

    @cached_property
    def scene(self) -> Scene:
        """Specimen, cards, tray and bench."""
        return build_scene(self.settings)

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen as it lies in the photos."""
        return self.scene.specimen

    @cached_property
    def marker_corners(self) -> Floats:
        """(N, 4, 3) mm, as the truth holds them."""
        return self.scene.cards.corners

    @cached_property
    def views(self) -> list[View]:
        """The photos' cameras."""
        return photo_views(self.settings)

    @cached_property
    def hsi_view(self) -> View:
        """The cube's camera."""
        return hsi_view(self.settings)

    @cached_property
    def motion(self) -> Pose | None:
        """Make the rigid map from the specimen's place in the photos to that in the cube; None if it stays."""
        return displacement(self.settings) if self.settings.moved else None

    def photos(self) -> Generator[tuple[str, NDArray[np.uint8]]]:
        """Name and upright RGB image (H, W, 3) of each photo, in order."""
        paint = Paint.of(self.scene, materials.linear_rgb())
        bare = without_cards(self.scene) if self.settings.bare_photos else self.scene
        scenes = [bare if i in self.settings.bare_photos else self.scene for i in range(self.settings.photos)]
        with ThreadPoolExecutor(_THREADS) as pool:
            images = pool.map(lambda i: self._photo(i, scenes[i], paint), range(self.settings.photos))
            try:
                for i, image in enumerate(images):
                    yield f"view_{i:03d}", image
            finally:
                # A caller that stops early does not wait for the remaining photos.
                pool.shutdown(wait=False, cancel_futures=True)

    def jpeg_quality(self, index: int) -> int:
        """Quality with which a photo is compressed, 1..100."""
        del index
        return _JPEG_QUALITY

    def _photo(self, index: int, scene: Scene, paint: Paint) -> NDArray[np.uint8]:
        s = self.settings
        rng = s.rng(Stream.PHOTO, index)
        linear = render_view(scene, self.views[index], paint, gloss=s.gloss).image
        if s.blur_px:
            linear = cv2.GaussianBlur(linear, (0, 0), s.blur_px)
        linear = linear * np.float32(2 ** (s.exposure_spread * rng.standard_normal()))
        encoded = srgb_from_linear(linear)
        encoded += np.float32(s.noise) * rng.standard_normal(encoded.shape, dtype=np.float32)
        return np.asarray(np.clip(encoded * 255 + 0.5, 0, 255), np.uint8)

    @cached_property
    def cube_rendering(self) -> Rendering:
        """What the cube's camera sees, one channel per material: each pixel's mixture, times its shading."""
        scene = self.scene if self.motion is None else build_scene(self.settings, self.motion)
        paint = Paint.of(scene, np.eye(len(materials.MATERIALS)), _CUBE_SHADING)
        rendering = render_view(scene, self.hsi_view, paint)
        self.take_back(rendering.xyz, rendering.classes)
        return rendering

    def take_back(self, xyz: Floats, classes: NDArray[np.uint8]) -> None:
        """Put the tissue that the cube's pixels saw, ``xyz`` (H, W, 3), where the photos show it: that is its truth."""
        if self.motion is not None:
            tissue = classes == CLASS_SPECIMEN
            xyz[tissue] = self.motion.inverse().apply(xyz[tissue])

    def reflectance(self, spectra: Singles) -> Singles:
        """What the cube's camera measures of endmembers (M, B) but for noise: (rows, columns, B)."""
        return np.asarray(self.cube_rendering.image @ spectra, np.float32)

    @cached_property
    def _defects(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Bad bands, and dead pixels (D, 2) row, column."""
        s = self.settings
        rng = s.rng(Stream.CUBE, 2)
        pixels = s.cube_rows * s.cube_cols
        bands = np.sort(rng.choice(s.bands, round(s.bad_band_fraction * s.bands), replace=False))
        dead = rng.choice(pixels, round(s.dead_pixel_fraction * pixels), replace=False)
        return bands, np.stack(np.divmod(np.sort(dead), s.cube_cols), 1)

    def cube(self) -> NDArray[np.uint16]:
        """Reflectance * 10000, (rows, columns, bands)."""
        s = self.settings
        rng = s.rng(Stream.CUBE)
        wavelengths = s.wavelengths_nm
        spectra = materials.endmembers(wavelengths).astype(np.float32)
        middle = (wavelengths - np.mean(s.wavelength_nm)) / (np.ptp(s.wavelength_nm) / 2)
        sd = (s.cube_noise * (1 + 3 * middle**4)).astype(np.float32)
        bad, dead = self._defects
        sd[bad] = 0.3
        reflectance = self.reflectance(spectra)
        reflectance[..., bad] = 0
        reflectance += sd * rng.standard_normal(reflectance.shape, dtype=np.float32)
        reflectance[dead[:, 0], dead[:, 1]] = 0
        reflectance *= REFLECTANCE_SCALE
        return np.asarray(np.clip(reflectance + 0.5, 0, 65535), np.uint16)

    @cached_property
    def truth(self) -> Truth:
        """Exact geometry and spectra."""
        s, rendering = self.settings, self.cube_rendering
        total = rendering.image.sum(2, keepdims=True)
        abundance = np.divide(rendering.image, total, out=np.zeros_like(rendering.image), where=total > 0)
        bad, dead = self._defects
        return Truth(
            marker_ids=np.array(s.marker_ids, np.int64),
            marker_corners=self.marker_corners,
            edge_mm=s.edge_mm,
            views=self.views,
            photo_names=[f"rgb/view_{i:03d}.jpg" for i in range(s.photos)],
            hsi_view=self.hsi_view,
            hsi_xyz=rendering.xyz.astype(np.float32),
            hsi_class=rendering.classes,
            abundance=abundance,
            endmembers=materials.endmembers(s.wavelengths_nm),
            wavelengths_nm=s.wavelengths_nm,
            materials=materials.MATERIALS,
            bad_bands=bad,
            dead_pixels=dead,
            vertices=self.specimen.vertices,
            triangles=self.specimen.triangles,
        )

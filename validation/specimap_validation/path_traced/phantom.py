"""A path-traced phantom: made from its settings as a quick one is, with the same parts and the same kind of truth."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from functools import cached_property

import numpy as np

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.geometry.cameras import View
from specimap_core.geometry.pushbroom import ScanView
from specimap_validation.path_traced.camera import Coat, take_picture
from specimap_validation.path_traced.cards import CardMeshes, bent_cards
from specimap_validation.path_traced.cube import first_hits, shift_bands
from specimap_validation.path_traced.lighting import trace_light
from specimap_validation.path_traced.optics import Optics, optics_of
from specimap_validation.path_traced.photo import develop
from specimap_validation.path_traced.renderer import start_renderer
from specimap_validation.path_traced.scan import UnevenScan
from specimap_validation.path_traced.settings import TracedSettings
from specimap_validation.path_traced.specimen import folded_specimen
from specimap_validation.path_traced.surfaces import LitScene, Painter, lit_scene
from specimap_validation.phantom import materials
from specimap_validation.phantom.noise import NoiseVolume
from specimap_validation.phantom.phantom import Phantom
from specimap_validation.phantom.render import Rendering
from specimap_validation.phantom.settings import Stream
from specimap_validation.phantom.specimen import Specimen, displaced
from specimap_validation.phantom.views import hsi_view, photo_views

_DETAIL_SD = 0.16
_MOST_ALBEDO = 0.95
_CUBE_BLUR_PX = 0.3
_CUBE_SHINE = 0.6  # the lamps of a hyperspectral camera are larger, and mirrored less brightly
_CUBE_SEED = 77


class TracedPhantom(Phantom):
    """A path-traced specimen with exact truth. Everything is made when first asked for, from the seed alone."""

    settings: TracedSettings

    def __init__(self, settings: TracedSettings) -> None:
        """Raises ``BackendUnavailableError`` where Mitsuba or its LLVM is not there."""
        start_renderer()
        super().__init__(settings)

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen as it lies in the photos."""
        return folded_specimen(self.settings)

    @cached_property
    def cards(self) -> CardMeshes:
        """The cards, which do not move."""
        return bent_cards(self.settings)

    @cached_property
    def marker_corners(self) -> Floats:
        """(N, 4, 3) mm, as the truth holds them."""
        return self.cards.corners

    @cached_property
    def views(self) -> list[View]:
        """The photos' cameras, in the middle of their exposures."""
        s = self.settings
        round_of = photo_views(replace(s, photos=s.photos * s.thinned))
        off = s.principal_spread_px * s.rng(Stream.CAMERAS, 1).standard_normal(2)
        return [_off_centre(view, off) for view in round_of[:: s.thinned]]

    @cached_property
    def hsi_view(self) -> View:
        """The cube's camera; of a push-broom, that of an even stage."""
        return _off_centre(hsi_view(self.settings), np.array(self.settings.cube_principal_px))

    @cached_property
    def uneven_view(self) -> View:
        """The cube's camera with the unevenness of its stage: what the cube is taken with."""
        s, even = self.settings, self.hsi_view
        if not isinstance(even, ScanView) or not (s.scan_drift or s.scan_jitter_px):
            return even
        lines = (even.intrinsics.width, even.intrinsics.height)[even.along]
        early = s.scan_jitter_px * s.rng(Stream.CUBE, 5).standard_normal(lines)
        motion = even.scan, even.skew, even.climb, even.depth_mm
        return UnevenScan(even.intrinsics, even.cam_from_world, *motion, s.scan_drift, tuple(early))

    @cached_property
    def _brightness(self) -> Singles:
        """Fine detail (V,) of the tissue, by which its colours are multiplied."""
        s = self.settings
        detail = NoiseVolume(s.rng(Stream.DETAIL), 0.35, 1.6, size=96, slope=0.8)(self.specimen.vertices)
        return np.asarray(np.clip(1 + s.texture_contrast * _DETAIL_SD * detail, 0.3, 1.7), np.float32)

    @cached_property
    def _albedo(self) -> Floats:
        """(V, 3)"""
        colours = (self.specimen.abundance @ materials.linear_rgb()) * self._brightness[:, None]
        return np.clip(colours, 0, _MOST_ALBEDO)

    @cached_property
    def lit(self) -> LitScene:
        """The scene of the photos."""
        light = trace_light(self.settings, self.specimen, self._albedo)
        return lit_scene(self.settings, self.specimen, self.cards, light)

    @property
    def _coat(self) -> Coat:
        s = self.settings
        return Coat(s.gloss, s.card_gloss, s.coat_roughness)

    def photos(self) -> Generator[tuple[str, Bytes]]:
        """Name and upright RGB image (H, W, 3) of each photo, in order."""
        s, lit = self.settings, self.lit
        painter = Painter(lit, materials.linear_rgb(), (0, 1, 2), self._albedo * lit.light.vertices)
        for i, view in enumerate(self.views):
            rng = s.rng(Stream.PHOTO, i)
            optics = optics_of(s, view, rng)
            seed = 1000 * s.seed + i
            picture, shine = take_picture(lit, view, painter, optics, self._coat, samples=s.samples, seed=seed)
            yield f"view_{i:03d}", develop(s, picture + shine, rng)

    def jpeg_quality(self, index: int) -> int:
        """Quality with which a photo is compressed, 1..100."""
        low, high = self.settings.quality
        return int(self.settings.rng(Stream.PHOTO, 10_000 + index).integers(low, high + 1))

    @cached_property
    def _cube_picture(self) -> tuple[Rendering, Singles]:
        """One channel per material as the cube's camera sees it, and what the coat mirrors (H, W), of all bands."""
        s = self.settings
        if self.motion is None and not s.covered:
            lit = self.lit
        else:
            specimen = self.specimen if self.motion is None else displaced(self.specimen, self.motion)
            light = self.lit.light if self.motion is None else trace_light(s, specimen, self._albedo)
            lit = lit_scene(s, specimen, self.cards, light, s.covered)
        # The spectrum of the light that surfaces throw at each other is that of the light: green stands for it.
        level = lit.light.vertices[:, 1] * self._brightness
        basis = np.eye(len(materials.MATERIALS))
        painter = Painter(lit, basis, (1,) * len(basis), lit.specimen.abundance * level[:, None])
        image, shine = take_picture(
            lit,
            self.uneven_view,
            painter,
            Optics(_CUBE_BLUR_PX),
            self._coat,
            samples=s.samples,
            seed=1000 * s.seed + _CUBE_SEED,
        )
        xyz, classes = first_hits(self.uneven_view, lit.meshes)
        self.take_back(xyz, classes)
        return Rendering(image, xyz, classes), np.asarray(_CUBE_SHINE * shine.mean(2), np.float32)

    @cached_property
    def cube_rendering(self) -> Rendering:
        """What the cube's camera sees, one channel per material: each pixel's mixture, times its shading."""
        return self._cube_picture[0]

    def reflectance(self, spectra: Singles) -> Singles:
        """What the cube's camera measures of endmembers (M, B) but for noise: (rows, columns, B)."""
        rendering, shine = self._cube_picture
        cube = np.asarray(rendering.image @ spectra + shine[..., None], np.float32)
        if self.settings.band_shift_px:
            shift_bands(cube, self.settings.band_shift_px, self.settings.rng(Stream.CUBE, 3))
        return cube


def _off_centre(view: View, off_px: Floats) -> View:
    lens = view.intrinsics
    return replace(view, intrinsics=replace(lens, cx=lens.cx + float(off_px[0]), cy=lens.cy + float(off_px[1])))

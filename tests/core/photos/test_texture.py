"""The share of a picture that is textured falls with the tissue's texture, not with gloss, light or noise."""

from __future__ import annotations

import numpy as np
import pytest

from specimap_core.photos.texture import between_markers, textured_share, usual_share
from specimap_validation.phantom import Phantom, PhantomSettings
from tests.support.feature_scene import photo_of


def scene(texture_contrast: float, gloss: float = 0.15) -> Phantom:
    """Two photos of it are quickly rendered."""
    return Phantom(
        PhantomSettings(photos=2, photo_size=320, mesh_divisions=40, texture_contrast=texture_contrast, gloss=gloss)
    )


def share(phantom: Phantom) -> float:
    """Between the markers."""
    corners = phantom.scene.cards.corners
    return usual_share(
        (photo_of(name, image), between_markers(v.intrinsics, v.cam_from_world, corners, image.shape[1::-1]))
        for (name, image), v in zip(phantom.photos(), phantom.views, strict=True)
    )


@pytest.fixture(scope="module")
def full() -> Phantom:
    return scene(1.0)


@pytest.fixture(scope="module")
def shares(full: Phantom) -> dict[float, float]:
    return {1.0: share(full)} | {contrast: share(scene(contrast)) for contrast in (0.5, 0.25, 0.0)}


@pytest.mark.slow
def test_it_falls_with_the_tissues_texture_and_stays_between_its_bounds(shares: dict[float, float]) -> None:
    assert (-np.diff(list(shares.values())) > 0.02).all(), shares
    # At contrast 0 lobules and vessels are left; the tray is plain.
    assert 0.2 < shares[0.0] < 0.7 < shares[1.0] < 0.99


def test_gloss_counts_for_much_less_than_texture(shares: dict[float, float]) -> None:
    glossy = share(scene(0.0, gloss=0.8))
    # Highlights have borders of their own; the detail within them is not the tissue's.
    assert 0.01 < glossy - shares[0.0] < (shares[1.0] - shares[0.0]) / 2


def test_noise_and_shading_are_no_texture_and_a_grain_is() -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:200, :240]
    for sd in (0, 1, 5):
        noisy = 100 + 0.3 * x + 0.2 * y + rng.normal(0, sd, x.shape)
        assert textured_share(np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)) < 0.01
    edges = np.asarray(np.where(x // 40 % 2, 60, 180), np.uint8)
    assert textured_share(edges) < 0.01  # they run in one direction
    flat = np.full(x.shape, 100.0)
    flat[:, 120:] += 20 * np.sin(x / 1.2)[:, 120:] * np.sin(y / 1.2)[:, 120:]
    grain = np.asarray(np.rint(flat + rng.normal(0, 1, x.shape)), np.uint8)
    assert 0.35 < textured_share(grain) <= 0.52
    right = np.zeros(grain.shape, bool)
    right[:, 130:] = True
    assert textured_share(grain, right) > 0.7
    assert textured_share(grain, ~right) < 0.1


def test_a_darker_exposure_changes_it_little(full: Phantom) -> None:
    (_, image), *_ = full.photos()
    grey = photo_of("a", image).grey
    darker = np.asarray(np.rint(0.7 * grey), np.uint8)
    assert textured_share(darker) == pytest.approx(textured_share(grey), abs=0.1)


def test_the_region_lies_between_the_markers_and_off_the_cards(full: Phantom) -> None:
    view, corners, size = full.views[0], full.scene.cards.corners, (320, 320)
    region = between_markers(view.intrinsics, view.cam_from_world, corners, size)
    assert region is not None
    assert region.shape == size[::-1]
    assert 0.05 < region.mean() < 0.5
    col, row = np.rint(view.project(np.array([[0.0, 0.0, 5.0]]))[0]).astype(int)
    assert region[row, col]
    for corner in view.project(corners.reshape(-1, 3)):
        col, row = np.rint(corner).astype(int)
        assert not region[row, col]
    assert between_markers(view.intrinsics, view.cam_from_world, corners[:2], size) is None


def test_of_many_photos_some_are_looked_at() -> None:
    looked = 0

    class Counting:
        @property
        def grey(self) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
            nonlocal looked
            looked += 1
            return photo_of("flat", np.full((32, 32, 3), 90, np.uint8)).grey

    assert usual_share((Counting(), None) for _ in range(100)) == 0  # type: ignore[misc]
    assert 6 <= looked <= 12

"""The preview shows materials apart, where they are, and leaves no other trace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.cloud import Cloud, preview
from specimap_core.cloud.preview import pca_colours, write_preview
from specimap_core.cloud.writer import write_cloud
from specimap_core.errors import SettingsError
from tests.support.cloud_scene import FakeCube, counts, scene


def read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA), np.uint8)


def quadrants(size: int = 64, bands: int = 12, noise: float = 30, seed: int = 0) -> NDArray[np.uint16]:
    """A cube (size, size, bands) of four materials, one in each quadrant."""
    rng = np.random.default_rng(seed)
    materials = rng.uniform(1000, 9000, (4, bands))
    row, col = np.mgrid[:size, :size] // (size // 2)
    values = materials[row * 2 + col] + rng.normal(0, noise, (size, size, bands))
    return np.asarray(np.clip(values, 0, 65535), np.uint16)


def test_principal_components_are_those_of_the_standardised_spectra() -> None:
    rng = np.random.default_rng(0)
    sample = rng.normal(size=(3000, 3)) * [5, 2, 1] @ rng.normal(size=(3, 10)) * 300 + 4000
    sample[:, 3] = 7  # a dead band
    bad = np.zeros(10, bool)
    bad[5] = True
    sample[:, 5] = rng.normal(0, 1e6, 3000)
    found = pca_colours(sample, bad)
    assert not found.weights[[3, 5]].any()
    kept = np.delete(np.arange(10), [3, 5])
    standard = (sample[:, kept] - sample[:, kept].mean(0)) / sample[:, kept].std(0)
    scores = np.linalg.svd(standard, full_matrices=False)[0][:, :3]
    colours = found.colours(sample)
    for i in range(3):
        assert abs(np.corrcoef(scores[:, i], colours[:, i])[0, 1]) > 0.9999
    np.testing.assert_allclose(np.percentile(colours, [2, 98], axis=0), [[0] * 3, [1] * 3], atol=2e-3)


def test_samples_without_spread() -> None:
    flat = pca_colours(np.full((50, 4), 100, np.uint16))
    np.testing.assert_array_equal(flat.colours(np.full((2, 4), 100)), np.full((2, 3), 0.5))
    single = pca_colours(np.arange(50, dtype=np.uint16)[:, None]).colours(np.arange(50)[:, None])
    assert single[0, 0] < 0.01
    assert single[-1, 0] > 0.99
    assert (single[:, 1:] == 0.5).all()


def test_preview_shows_materials_where_they_are(tmp_path: Path) -> None:
    points = scene(64, 64, share=1)
    write_cloud(tmp_path / "c.zarr", points, FakeCube(quadrants()), {})
    write_preview(Cloud.open(tmp_path / "c.zarr"), tmp_path / "preview.png")
    image = read(tmp_path / "preview.png").astype(int)
    assert image.shape == (64, 64, 4)
    assert (image[..., 3] == 255).all()
    # The scene has x along columns and y against rows: the picture, y up, is upright as the cube.
    corners = [image[r : r + 28, c : c + 28, :3].reshape(-1, 3) for r in (2, 34) for c in (2, 34)]
    means = np.array([c.mean(0) for c in corners])
    spread = max(c.std(0).max() for c in corners)
    apart = min(np.linalg.norm(means[i] - means[j]) for i in range(4) for j in range(i))
    assert 0 < spread < 60
    assert apart > 100
    write_preview(Cloud.open(tmp_path / "c.zarr"), tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "preview.png").read_bytes()


def test_holes_are_filled_within_two_cells(tmp_path: Path) -> None:
    points = scene(64, 64, share=1)
    row, col = points.hsi_pixel.astype(int).T
    small = (abs(row - 20) <= 1) & (abs(col - 20) <= 1)
    large = (abs(row - 44) <= 6) & (abs(col - 44) <= 6)
    kept = ~(small | large)
    points = replace(points, **{name: values[kept] for name, values in vars(points).items()})
    write_cloud(tmp_path / "c.zarr", points, FakeCube(quadrants()), {})
    write_preview(Cloud.open(tmp_path / "c.zarr"), tmp_path / "preview.png")
    alpha = read(tmp_path / "preview.png")[..., 3]
    assert (alpha[19:22, 19:22] == 255).all()
    # The nearest point of the large hole's centre is 7 cells away; 2 cells at each border are filled.
    assert (alpha[38:51, 38:51] == 0).sum() == 9 * 9


def test_a_large_scene_is_shown_coarser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preview, "MOST_PIXELS_A_SIDE", 100)
    points = scene(20, 20)
    stretched = replace(points, xyz=points.xyz * np.float32(1000))
    write_cloud(tmp_path / "c.zarr", stretched, FakeCube(counts(20, 20, 3)), {})
    write_preview(Cloud.open(tmp_path / "c.zarr"), tmp_path / "preview.png")
    assert 99 <= max(read(tmp_path / "preview.png").shape) <= 100
    with pytest.raises(SettingsError):
        write_preview(Cloud.open(tmp_path / "c.zarr"), tmp_path / "none.png", grid_mm=-1)
    assert not (tmp_path / "none.png").exists()

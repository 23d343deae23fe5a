"""Every type of pixels comes out as 8-bit colour of the right brightness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from specimap_core.photos.reading import read_photo
from tests.support.photo_files import SETTINGS, pattern


def test_cmyk_progressive_and_grey_jpegs(tmp_path: Path) -> None:
    image = pattern()
    Image.fromarray(image).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    Image.fromarray(image).save(tmp_path / "progressive.jpg", quality=95, progressive=True)
    Image.fromarray(image).convert("L").save(tmp_path / "grey.jpg", quality=95)
    for name in ("cmyk", "progressive"):
        assert np.abs(read_photo(tmp_path / f"{name}.jpg", SETTINGS).image.astype(int) - image).mean() < 8
    grey = read_photo(tmp_path / "grey.jpg", SETTINGS).image
    assert np.ptp(grey.astype(int), axis=2).max() == 0
    assert np.abs(grey[..., 0].astype(int) - np.asarray(Image.fromarray(image).convert("L"))).mean() < 4


@pytest.mark.parametrize("mode", ["LA", "RGBA", "P"])
@pytest.mark.parametrize("kind", ["PNG", "TIFF", "WEBP"])
def test_palettes_and_transparency(tmp_path: Path, mode: str, kind: str) -> None:
    image = np.repeat(pattern()[..., :1], 3, axis=2)
    picture = Image.fromarray(image)
    picture = picture.quantize(256).convert(mode) if "P" in mode else picture.convert(mode)
    picture.save(tmp_path / "photo", kind, **({"quality": 95} if kind == "WEBP" else {}))
    assert np.abs(read_photo(tmp_path / "photo", SETTINGS).image.astype(int) - image).mean() < 8


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("kind", ["PNG", "TIFF"])
def test_grey_of_more_bits_keeps_its_brightness(tmp_path: Path, bits: int, kind: str) -> None:
    grey = pattern()[..., 0].copy()
    grey[0, 0] = 255
    deep = np.round(grey / 255 * (2**bits - 1)).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "photo", kind)
    assert np.abs(read_photo(tmp_path / "photo", SETTINGS).image[..., 0].astype(int) - grey).max() <= 1


def test_colour_of_sixteen_bits(tmp_path: Path) -> None:
    import cv2

    image = pattern()
    for name in ("photo.png", "photo.tif"):
        assert cv2.imwrite(str(tmp_path / name), image[..., ::-1].astype(np.uint16) * 257)
        assert np.abs(read_photo(tmp_path / name, SETTINGS).image.astype(int) - image).max() <= 1


def test_floats_of_zero_to_one_are_not_black(tmp_path: Path) -> None:
    grey = pattern()[..., 0]
    Image.fromarray(grey.astype(np.float32) / 255).save(tmp_path / "photo.tif")
    assert np.abs(read_photo(tmp_path / "photo.tif", SETTINGS).image[..., 0].astype(int) - grey).max() <= 1

"""Photos of several resolutions, lenses and cameras in one folder: one camera's stay, others are foreign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import read_photos
from specimap_core.screening.photo import Others, judge_photo
from tests.support.photo_files import SETTINGS, pattern
from tests.support.places import SAMPLES


def phone(path: Path, width: int, height: int, seed: int, **exif: Any) -> Path:
    """A JPEG with EXIF fields by name; Make and Model stand in the first directory."""
    tags = Image.Exif()
    for name, value in exif.items():
        key = getattr(ExifTags.Base, name).value
        (tags if name in ("Make", "Model", "Orientation") else tags.get_ifd(ExifTags.IFD.Exif))[key] = value
    Image.fromarray(pattern(width, height, seed)).save(path, "JPEG", quality=95, exif=tags)
    return path


APPLE: dict[str, Any] = {"Make": "Apple", "Model": "iPhone 13", "FocalLengthIn35mmFilm": 26, "FocalLength": 5.1}


def test_two_resolutions_of_one_phone_are_one_camera(tmp_path: Path) -> None:
    for k in range(8):
        width, height = ((400, 300), (200, 150))[k % 2]
        phone(tmp_path / f"{k}.jpg", width, height, k, **APPLE)
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert not refused
    assert {p.size for p in photos} == {(160, 120)}
    assert len({p.focal_px for p in photos}) == 1
    assert {p.full_size for p in photos} == {(400, 300), (200, 150)}


@pytest.mark.parametrize("turned", [1, 6, 8, 3])
def test_resolutions_and_turns_together(tmp_path: Path, turned: int) -> None:
    for k in range(6):
        phone(tmp_path / f"{k}.jpg", 400, 300, k, **APPLE)
    stored = phone(tmp_path / "9.jpg", 240, 180, 9, **APPLE, Orientation=turned)
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert not refused
    with Image.open(stored) as opened:
        upright = ImageOps.exif_transpose(opened)
        sensor = np.asarray(opened.resize((160, 120), Image.Resampling.BOX), int)
        expected = np.asarray(upright.resize((160, 120), Image.Resampling.BOX), int) if turned == 3 else sensor
    assert photos[-1].size == (160, 120)
    assert np.abs(photos[-1].image.astype(int) - expected).mean() < 8


def test_a_smaller_photo_is_enlarged_to_the_others(tmp_path: Path) -> None:
    for k in range(4):
        phone(tmp_path / f"{k}.jpg", 400, 300, k, **APPLE)
    phone(tmp_path / "small.jpg", 100, 75, 8, **APPLE)
    phone(tmp_path / "tiny.jpg", 64, 48, 9, **APPLE)
    photos, (tiny,) = read_photos(photo_paths(tmp_path), SETTINGS)
    assert {p.size for p in photos} == {(160, 120)}
    assert photos[-1].focal_px == pytest.approx(photos[0].focal_px)
    assert (tiny.name, tiny.code) == ("tiny.jpg", "photo_foreign")
    assert "too small beside them" in tiny.reason


@pytest.mark.parametrize(
    ("size", "exif", "reason"),
    [
        ((200, 150), {}, "EXIF does not say that the same camera"),
        ((200, 150), {**APPLE, "FocalLengthIn35mmFilm": 52}, "another lens or zoom"),
        ((200, 150), {**APPLE, "FocalLength": 1.57}, "another lens or zoom"),
        ((200, 150), {**APPLE, "DigitalZoomRatio": 2.0}, "another zoom"),
        ((200, 150), {**APPLE, "Model": "iPhone 8"}, "another camera"),
        ((200, 160), APPLE, "a part cut out"),
        ((400, 300), {**APPLE, "FocalLengthIn35mmFilm": 13}, "another lens or zoom"),
        ((400, 300), {**APPLE, "Model": "iPhone 8"}, "another camera"),
        ((300, 400), {**APPLE, "FocalLength": 1.57}, "another lens or zoom"),
    ],
)
def test_another_lens_or_a_crop_is_foreign(
    tmp_path: Path, size: tuple[int, int], exif: dict[str, Any], reason: str
) -> None:
    for k in range(4):
        phone(tmp_path / f"{k}.jpg", 400, 300, k, **APPLE)
    phone(tmp_path / "odd.jpg", *size, 9, **exif)
    photos, (odd,) = read_photos(photo_paths(tmp_path), SETTINGS)
    assert len(photos) == 4
    assert (odd.name, odd.code) == ("odd.jpg", "photo_foreign")
    assert reason in odd.reason


def test_focal_lengths_that_breathe_are_one_lens(tmp_path: Path) -> None:
    for k in range(6):
        phone(tmp_path / f"{k}.jpg", 400, 300, k, **{**APPLE, "FocalLengthIn35mmFilm": 26 + k % 2})
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert (len(photos), refused) == (6, [])


def test_arriving_photos_of_another_resolution_are_no_doubt() -> None:
    path = SAMPLES / "rgb" / "view_000.jpg"
    for others, code in (([(3000, 3000)] * 3, None), ([(256, 256)] * 3, None), ([(1600, 900)] * 3, "photo_foreign")):
        assert judge_photo(path, "DICT_4X4_50", Others(sizes=others)).code == code

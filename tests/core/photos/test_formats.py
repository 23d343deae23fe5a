"""Every format of photos, turned every way, comes into one frame; the one list of formats and suffixes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from specimap_core.errors import PhotoUnreadableError, SpecimapError
from specimap_core.photos.decoding import photo_suffix
from specimap_core.photos.folder import photo_folder, photo_paths
from specimap_core.photos.formats import FORMATS, MEDIA_TYPES, PHOTO_SUFFIXES, suffix_of
from specimap_core.photos.reading import read_photo, read_photos
from specimap_core.screening.photo import Others, judge_photo
from tests.support.photo_files import SETTINGS, pattern, written

WITH_EXIF = ["JPEG", "MPO", "HEIF", "PNG", "TIFF", "WEBP", "AVIF"]
UPRIGHT: dict[int, Any] = {
    1: lambda a: a,
    2: np.fliplr,
    3: lambda a: np.rot90(a, 2),
    4: np.flipud,
    5: lambda a: np.swapaxes(a, 0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(np.swapaxes(a, 0, 1), 2),
    8: np.rot90,
}
"""How what the sensor read is turned upright, by the EXIF standard's table of orientations."""
TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 1, 6: 1, 7: 3, 8: 3}


@pytest.mark.parametrize("orientation", list(UPRIGHT))
@pytest.mark.parametrize("kind", WITH_EXIF)
def test_each_format_in_each_orientation(tmp_path: Path, kind: str, orientation: int) -> None:
    stored = pattern(120, 80)
    photo = read_photo(written(tmp_path / "photo", stored, kind, orientation), SETTINGS)
    expected = UPRIGHT[orientation](stored)
    assert photo.full_size == photo.size == expected.shape[1::-1]
    assert photo.quarter_turns == TURNS[orientation]
    assert np.abs(photo.image.astype(int) - expected).mean() < 8
    # Any other way round is far from it.
    for other, turn in UPRIGHT.items():
        if other != orientation and turn(stored).shape == expected.shape:
            assert np.abs(photo.image.astype(int) - turn(stored)).mean() > 15


@pytest.mark.parametrize("kind", WITH_EXIF)
@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_one_turned_photo_among_upright_ones(tmp_path: Path, kind: str, orientation: int) -> None:
    """All come into one frame, whatever reader turned them."""
    sensor = [pattern(seed=k) for k in range(5)]
    suffix = suffix_of(kind)
    for k, image in enumerate(sensor):
        written(tmp_path / f"{k}{suffix}", image, kind, orientation if k == 2 else 1)
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert not refused
    assert {p.full_size for p in photos} == {(120, 80)}
    for k, (photo, image) in enumerate(zip(photos, sensor, strict=True)):
        expected = np.rot90(image, 2) if k == 2 and orientation == 3 else image
        assert np.abs(photo.image.astype(int) - expected).mean() < 8


@pytest.mark.slow
@pytest.mark.parametrize("kind", WITH_EXIF)
def test_large_turned_photos_come_to_working_size(tmp_path: Path, kind: str) -> None:
    stored = pattern(1200, 900)
    photo = read_photo(written(tmp_path / "photo", stored, kind, 6), SETTINGS)
    assert photo.full_size == (900, 1200)
    assert photo.size == (120, 160)
    expected = np.asarray(Image.fromarray(np.rot90(stored, -1)).resize((120, 160), Image.Resampling.BOX))
    assert np.abs(photo.image.astype(int) - expected).mean() < 4


def test_a_picture_without_exif_stays_as_it_is(tmp_path: Path) -> None:
    stored = pattern()
    for kind in FORMATS:
        photo = read_photo(written(tmp_path / kind, stored, kind), SETTINGS)
        assert photo.full_size == (120, 80)
        assert np.abs(photo.image.astype(int) - stored).mean() < 8


# ---- the one list -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(FORMATS))
def test_what_is_stored_is_found_again(tmp_path: Path, kind: str) -> None:
    """An upload is stored under a suffix by its content, under which a job's folder shows it and a browser knows it."""
    path = written(tmp_path / "upload", pattern(600, 400), kind)
    suffix = photo_suffix(path)
    assert suffix in PHOTO_SUFFIXES
    assert MEDIA_TYPES[suffix].startswith("image/")
    stored = path.rename(tmp_path / f"photo{suffix}")
    assert photo_paths(tmp_path) == [stored]
    verdict = judge_photo(stored, "DICT_4X4_50", Others())
    assert (verdict.facts["suffix"], verdict.facts["width"], verdict.facts["height"]) == (suffix, 600, 400)


@pytest.mark.parametrize("suffix", sorted(PHOTO_SUFFIXES))
@pytest.mark.parametrize("upper", [False, True])
def test_every_suffix_is_read_by_content(tmp_path: Path, suffix: str, upper: bool) -> None:
    path = tmp_path / f"IMG_0001{suffix.upper() if upper else suffix}"
    written(path, pattern(), "JPEG")
    assert photo_paths(tmp_path) == [path]
    assert read_photo(path, SETTINGS).full_size == (120, 80)


@pytest.mark.parametrize("kind", ["GIF", "PPM", "TGA", "ICO", "SGI", "PCX", "EPS", "PDF", "JPEG2000"])
def test_other_parsers_do_not_see_a_file(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "photo.jpg"
    Image.fromarray(pattern()).save(path, kind)
    with pytest.raises(PhotoUnreadableError, match="no known image format"):
        read_photo(path, SETTINGS)


def test_what_is_passed_over_is_named(tmp_path: Path) -> None:
    written(tmp_path / "a.JPG", pattern(), "JPEG")
    written(tmp_path / "b.HIF", pattern(), "HEIF")
    (tmp_path / "c.DNG").write_bytes(b"raw")
    (tmp_path / "film.mov").write_bytes(b"film")
    (tmp_path / ".DS_Store").write_bytes(b"litter")
    (tmp_path / "day 2").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "day 2" / "d.webp").write_bytes(b"x")
    found = photo_folder(tmp_path)
    assert [p.name for p in found.photos] == ["a.JPG", "b.HIF", "c.DNG"]
    assert dict(found.passed_over) == {
        "day 2": "a folder with 1 photo",
        "empty": "a folder",
        "film.mov": "its name does not end as a photo's",
    }
    (warning,) = found.warnings()
    assert warning.code == "files_passed_over"
    assert all(name in warning.message for name, _ in found.passed_over)
    with pytest.raises(SpecimapError, match=r"day 2 \(a folder with 1 photo\)") as few:
        read_photos(found.photos, SETTINGS)
    assert "c.DNG" in few.value.details["refused"]  # type: ignore[operator]


def test_photos_in_a_folder_of_the_folder_are_told_of(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    for k in range(3):
        written(tmp_path / "rgb" / f"{k}.jpg", pattern(seed=k), "JPEG")
    with pytest.raises(SpecimapError, match=r"rgb \(a folder with 3 photos\)") as none:
        photo_paths(tmp_path)
    assert none.value.code == "too_few_photos"

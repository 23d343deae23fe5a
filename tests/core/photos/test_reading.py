"""Photos as phones deliver them, and as they should not be."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image

from specimap_core.errors import NotFoundError, PhotoUnreadableError, TooFewPhotosError
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, read_photo, read_photos
from tests.support.photo_files import SETTINGS, bomb, pattern


def save(path: Path, image: NDArray[np.uint8], **exif: object) -> Path:
    """Write a photo with EXIF fields by their names."""
    tags = Image.Exif()
    details = {getattr(ExifTags.Base, k).value: v for k, v in exif.items() if k != "Orientation"}
    if "Orientation" in exif:
        tags[ExifTags.Base.Orientation] = exif["Orientation"]
    tags.get_ifd(ExifTags.IFD.Exif).update(details)
    if path.suffix in (".jpg", ".heic"):
        Image.fromarray(image).save(path, exif=tags, quality=95)
    else:
        Image.fromarray(image).save(path, exif=tags)
    return path


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".heic", ".JPG"])
def test_formats_read_alike(tmp_path: Path, suffix: str) -> None:
    image = pattern()
    path = tmp_path / f"photo{suffix}"
    save(path.with_suffix(suffix.lower()), image).rename(path)
    photo = read_photo(path, SETTINGS)
    assert photo.size == (120, 80)
    assert np.abs(photo.image.astype(int) - image).mean() < 6
    assert photo.image.dtype == np.uint8


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "I;16", "1"])
def test_kinds_of_pixels_become_rgb(tmp_path: Path, mode: str) -> None:
    grey = pattern()[..., 0]
    if mode == "I;16":
        image = Image.fromarray(grey.astype(np.uint16) * 257)
    else:
        image = Image.fromarray(grey).convert(mode)
    image.save(tmp_path / "photo.png")
    photo = read_photo(tmp_path / "photo.png", SETTINGS)
    assert photo.image.shape == (80, 120, 3)
    if mode != "1":
        assert np.abs(photo.image[..., 0].astype(int) - grey).mean() < 8


@pytest.mark.parametrize(
    ("orientation", "turn"),
    [(1, lambda a: a), (2, np.fliplr), (3, lambda a: np.rot90(a, 2)), (6, lambda a: np.rot90(a, -1)), (8, np.rot90)],
)
def test_exif_turns_photos_upright(tmp_path: Path, orientation: int, turn: object) -> None:
    stored = pattern()
    photo = read_photo(save(tmp_path / "p.png", stored, Orientation=orientation), SETTINGS)
    expected = turn(stored)  # type: ignore[operator]
    assert photo.image.shape == expected.shape
    assert np.array_equal(photo.image, expected)
    assert photo.full_size == expected.shape[1::-1]


def test_large_photos_come_to_working_size(tmp_path: Path) -> None:
    photo = read_photo(save(tmp_path / "p.jpg", pattern(1200, 900), FocalLengthIn35mmFilm=26), SETTINGS)
    assert photo.size == (160, 120)
    assert photo.full_size == (1200, 900)
    # 26 mm on a diagonal of 43.27 mm; the working diagonal has 200 pixels.
    assert photo.focal_px == pytest.approx(26 / 43.267 * 200, rel=1e-3)
    assert read_photo(save(tmp_path / "q.jpg", pattern()), SETTINGS).size == (120, 80)


@pytest.mark.parametrize("value", [0, 1, 5000])
def test_absurd_focal_lengths_are_ignored(tmp_path: Path, value: int) -> None:
    assert read_photo(save(tmp_path / "p.jpg", pattern(), FocalLengthIn35mmFilm=value), SETTINGS).focal_px is None


def test_the_subject_distance_is_read_in_millimetres(tmp_path: Path) -> None:
    assert read_photo(save(tmp_path / "p.jpg", pattern(), SubjectDistance=0.25), SETTINGS).subject_mm == 250
    assert read_photo(save(tmp_path / "q.jpg", pattern()), SETTINGS).subject_mm is None


def test_blur_lowers_the_sharpness(tmp_path: Path) -> None:
    sharp = pattern(seed=3)
    blurred = np.asarray(Image.fromarray(sharp).resize((12, 8)).resize((120, 80)), np.uint8)
    first, second = (read_photo(save(tmp_path / f"{k}.png", i), SETTINGS) for k, i in enumerate((sharp, blurred)))
    assert second.sharpness < 0.2 * first.sharpness


def test_what_is_no_photo_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("not a photo\n" * 50)
    (tmp_path / "empty.jpg").write_bytes(b"")
    whole = save(tmp_path / "whole.jpg", pattern()).read_bytes()
    (tmp_path / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "script.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\nshowpage\n")
    png = bytearray(save(tmp_path / "whole.png", pattern()).read_bytes())
    png[60:90] = b"\xff" * 30
    (tmp_path / "damaged.png").write_bytes(png)
    bomb(tmp_path / "bomb.png")
    for name in ("text.jpg", "empty.jpg", "cut.jpg", "script.jpg", "damaged.png", "bomb.png"):
        with pytest.raises(PhotoUnreadableError) as refused:
            read_photo(tmp_path / name, SETTINGS)
        assert name in refused.value.message
        assert refused.value.details["photo"] == name


def test_random_damage_never_gets_through_as_another_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    sources = [
        save(tmp_path / f"whole{s}", pattern(), Orientation=6, SubjectDistance=0.3).read_bytes()
        for s in (".jpg", ".png", ".tif")
    ]
    for k in range(60):
        data = bytearray(sources[k % 3])
        for at in rng.integers(0, min(len(data), 400), 6):
            data[at] = rng.integers(256)
        path = tmp_path / "damaged.jpg"
        path.write_bytes(data)
        with suppress(PhotoUnreadableError):
            read_photo(path, SETTINGS)


def test_the_folder_is_listed_by_name(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.PNG", ".hidden.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "folder.jpg").mkdir()
    assert [p.name for p in photo_paths(tmp_path)] == ["a.PNG", "b.jpg"]
    with pytest.raises(NotFoundError):
        photo_paths(tmp_path / "none")
    (tmp_path / "bare").mkdir()
    with pytest.raises(TooFewPhotosError):
        photo_paths(tmp_path / "bare")


def test_bad_photos_among_good_ones_are_left_out(tmp_path: Path) -> None:
    for k in range(4):
        save(tmp_path / f"good{k}.jpg", pattern(seed=k))
    (tmp_path / "good0_copy.jpg").write_bytes((tmp_path / "good0.jpg").read_bytes())
    (tmp_path / "text.jpg").write_text("no photo")
    save(tmp_path / "other_camera.jpg", pattern(100, 100))
    heard: list[float] = []
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS, progress=heard.append)
    assert [p.name for p in photos] == [f"good{k}.jpg" for k in range(4)]
    assert {r.name: r.code for r in refused} == {
        "good0_copy.jpg": "photo_duplicate",
        "text.jpg": "photo_unreadable",
        "other_camera.jpg": "photo_foreign",
    }
    assert heard[-1] == 1.0


def test_too_few_are_refused_and_say_why(tmp_path: Path) -> None:
    for k in range(2):
        save(tmp_path / f"good{k}.jpg", pattern(seed=k))
    with pytest.raises(TooFewPhotosError):
        read_photos(photo_paths(tmp_path), SETTINGS)
    (tmp_path / "text.jpg").write_text("no photo")
    with pytest.raises(PhotoUnreadableError) as refused:
        read_photos(photo_paths(tmp_path), SETTINGS)
    assert refused.value.details["refused"]


@pytest.mark.parametrize(("usual", "rare"), [(1, 6), (1, 8), (6, 1), (8, 1)])
def test_photos_held_the_other_way_are_turned_back_to_the_sensor(tmp_path: Path, usual: int, rare: int) -> None:
    sensor = [pattern(seed=k) for k in range(5)]
    for k, image in enumerate(sensor):
        save(tmp_path / f"{k}.png", image, Orientation=rare if k == 3 else usual)
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert not refused
    assert len({p.full_size for p in photos}) == 1
    assert len({p.size for p in photos}) == 1
    # All are turned alike from how the sensor read them, so one principal point holds for all.
    turns = photos[0].quarter_turns
    for photo, image in zip(photos, sensor, strict=True):
        assert photo.quarter_turns == turns
        assert np.array_equal(photo.image, np.rot90(image, -turns))


def test_a_transposed_photo_without_exif_is_turned_too(tmp_path: Path) -> None:
    for k in range(4):
        image = pattern(seed=k)
        save(tmp_path / f"{k}.png", np.ascontiguousarray(np.rot90(image)) if k == 2 else image)
    photos, refused = read_photos(photo_paths(tmp_path), SETTINGS)
    assert not refused
    assert {p.size for p in photos} == {(120, 80)}


def test_real_photos_share_one_frame(data_dir: Path) -> None:
    """Stored with EXIF orientation 6: pixels are upright, whatever reads them."""
    paths = photo_paths(data_dir / "real_exif_rotated" / "images")
    photos, refused = read_photos(paths, AcquisitionSettings(working_px=1280, least_photos=3))
    assert not refused
    for path, photo in zip(paths, photos, strict=True):
        with Image.open(path) as stored:
            assert stored.getexif()[ExifTags.Base.Orientation] == 6
            assert photo.full_size == stored.size[::-1]
        assert photo.size[1] == 1280
        assert photo.size[0] < 1280
        assert photo.quarter_turns == 1

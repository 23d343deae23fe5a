"""Every format of photos, turned every way, and every kind of pixels: one frame, the right size, the right values."""

from __future__ import annotations

import errno
import io
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from specimap_core.errors import PhotoRawError, PhotoUnreadableError, SpecimapError
from specimap_core.photos.decoding import decode_photo, photo_suffix
from specimap_core.photos.folder import photo_folder, photo_paths
from specimap_core.photos.formats import FORMATS, MEDIA_TYPES, PHOTO_SUFFIXES, suffix_of
from specimap_core.photos.reading import AcquisitionSettings, read_photo, read_photos
from specimap_core.screening.photo import Others, judge_photo
from tests.support.photo_files import SETTINGS, pattern
from tests.support.places import SAMPLES

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


def written(path: Path, image: NDArray[np.uint8], kind: str, orientation: int | None = None, **options: Any) -> Path:
    """A photo in a format of Pillow's name."""
    exif = Image.Exif()
    if orientation:
        exif[ExifTags.Base.Orientation] = orientation
    picture = Image.fromarray(image)
    if kind == "MPO":
        options = {"save_all": True, "append_images": [picture.resize((30, 20))], **options}
    if kind in ("JPEG", "MPO", "HEIF", "WEBP", "AVIF"):
        options = {"quality": 95, **options}
    if kind != "BMP":
        # As bytes: for HEIF the writer then adds the rotation that readers go by, as phones do.
        options["exif"] = exif.tobytes()
    picture.save(path, kind, **options)
    return path


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


# ---- raw files ----------------------------------------------------------------------------------------


def dng(path: Path) -> Path:
    """A TIFF with DNG's version tag and whatever else a raw file says, its picture a small preview."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    directory = ImageFileDirectory_v2()
    directory[50706] = b"\x01\x04\x00\x00"
    Image.fromarray(pattern(256, 171)).save(path, "TIFF", tiffinfo=directory)
    return path


def test_raw_files_are_refused_by_name_and_reason(tmp_path: Path) -> None:
    for name in ("IMG_1.DNG", "renamed.tif", "renamed.jpg"):
        with pytest.raises(PhotoRawError, match=rf"{name} is a raw file.*export it as JPEG") as refused:
            read_photo(dng(tmp_path / name), SETTINGS)
        assert refused.value.code == "photo_raw"
    (tmp_path / "IMG_2.CR3").write_bytes(b"whatever")
    with pytest.raises(PhotoRawError, match=r"IMG_2\.CR3"):
        read_photo(tmp_path / "IMG_2.CR3", SETTINGS)
    with pytest.raises(PhotoRawError):
        read_photos(photo_paths(tmp_path), SETTINGS)
    upload = dng(tmp_path / "upload")
    assert judge_photo(upload, "DICT_4X4_50", Others()).code == "photo_raw"


def test_a_raw_file_beside_jpegs_is_named(tmp_path: Path) -> None:
    for k in range(4):
        written(tmp_path / f"{k}.jpg", pattern(seed=k), "JPEG")
    dng(tmp_path / "4.DNG")
    photos, (refused,) = read_photos(photo_paths(tmp_path), SETTINGS)
    assert len(photos) == 4
    assert (refused.name, refused.code) == ("4.DNG", "photo_raw")


# ---- kinds of pixels ----------------------------------------------------------------------------------


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


# ---- what is no photo ---------------------------------------------------------------------------------


def test_animations_and_pages_are_no_photo(tmp_path: Path) -> None:
    frames = [Image.fromarray(pattern(seed=k)) for k in range(3)]
    for kind in ("WEBP", "PNG", "AVIF", "TIFF"):
        frames[0].save(tmp_path / kind, kind, save_all=True, append_images=frames[1:])
        with pytest.raises(PhotoUnreadableError, match=r"animation|3 pages"):
            read_photo(tmp_path / kind, SETTINGS)
    frames[0].save(tmp_path / "preview.tif", "TIFF", save_all=True, append_images=[frames[1].resize((30, 20))])
    assert read_photo(tmp_path / "preview.tif", SETTINGS).full_size == (120, 80)


@pytest.mark.parametrize("kind", list(FORMATS))
def test_cut_and_empty_files_are_refused(tmp_path: Path, kind: str) -> None:
    whole = written(tmp_path / "whole", pattern(240, 160), kind).read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9):
        (tmp_path / "cut").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(PhotoUnreadableError, match="cut"):
            read_photo(tmp_path / "cut", SETTINGS)


def test_huge_dimensions_are_refused_before_decoding(tmp_path: Path) -> None:
    def bmp(width: int, height: int) -> bytes:
        header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
        return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + header

    def webp(width: int, height: int) -> bytes:
        canvas = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
        body = b"WEBPVP8X" + struct.pack("<I", 10) + b"\0\0\0\0" + canvas
        return b"RIFF" + struct.pack("<I", len(body)) + body

    tiff = io.BytesIO()
    Image.new("1", (20_000, 20_000)).save(tiff, "TIFF", compression="group4")
    for data in (bmp(60_000, 60_000), tiff.getvalue(), webp(16_383, 16_383)):
        (tmp_path / "bomb").write_bytes(data)
        with pytest.raises(PhotoUnreadableError):
            decode_photo(tmp_path / "bomb", 1280)
    (tmp_path / "bomb").write_bytes(tiff.getvalue())
    with pytest.raises(PhotoUnreadableError, match="20000 x 20000 pixels, more than any phone"):
        decode_photo(tmp_path / "bomb", 1280)


def test_slivers_are_no_photo(tmp_path: Path) -> None:
    for size in ((20_000, 1), (1, 20_000), (5000, 40), (8, 8)):
        Image.new("RGB", size).save(tmp_path / "sliver.png")
        with pytest.raises(PhotoUnreadableError, match="too few"):
            read_photo(tmp_path / "sliver.png", AcquisitionSettings())


def test_a_photo_that_may_not_be_read_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "photo.jpg", pattern(), "JPEG")

    def forbidden(_: Path) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "read_bytes", forbidden)
    with pytest.raises(PhotoUnreadableError, match="Permission denied") as refused:
        read_photo(path, SETTINGS)
    assert "account" in refused.value.advice


# ---- one camera ---------------------------------------------------------------------------------------


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

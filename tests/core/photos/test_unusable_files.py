"""Raw, cut, huge, animated and unreadable files are refused with their reason."""

from __future__ import annotations

import errno
import io
import os
import struct
from pathlib import Path

import pytest
from PIL import Image

from specimap_core.errors import PhotoRawError, PhotoTooLargeError, PhotoUnreadableError
from specimap_core.photos.decoding import check_pixels, decode_photo
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.formats import FORMATS
from specimap_core.photos.reading import AcquisitionSettings, read_photo, read_photos
from specimap_core.screening.photo import Others, judge_photo
from tests.support.photo_files import SETTINGS, pattern, written

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


def test_what_would_be_decoded_whole_is_measured_by_its_header(tmp_path: Path) -> None:
    picture = Image.fromarray(pattern(400, 300))
    for name, progressive, whole in (
        ("a.png", False, True),
        ("a.tif", False, True),
        ("a.webp", False, True),
        ("a.jpg", True, True),
        ("b.jpg", False, False),
    ):
        path = tmp_path / name
        picture.save(path, progressive=progressive)
        check_pixels(path, 400 * 300)
        if not whole:
            check_pixels(path, 1000)
            continue
        with pytest.raises(PhotoTooLargeError, match="400 x 300 pixels") as refused:
            check_pixels(path, 400 * 300 - 1)
        assert refused.value.details["limit_pixels"] == 400 * 300 - 1
        assert refused.value.advice
        if name == "a.png":  # the rest of the file need not even be there
            path.write_bytes(path.read_bytes()[:1000])
        verdict = judge_photo(path, "DICT_4X4_50", Others(), 1000)
        assert (verdict.verdict, verdict.code) == ("refused", "photo_too_large"), name
        assert verdict.reason.startswith("The photo has 400 x 300 pixels")

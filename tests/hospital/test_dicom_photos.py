"""Photos become frames that any viewer shows upright, and nothing that a phone wrote beside the picture is left."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms
from pydicom import Dataset, dcmread

from specimap_core.errors import PhotoTooLargeError, PhotoUnreadableError
from specimap_hospital.dicom.header import Header
from specimap_hospital.dicom.jpeg import baseline_frame, rgb_profile
from specimap_hospital.dicom.photos import photo_frame, write_photo
from specimap_infra.study_context import StudyContext
from tests.support.dicom_scene import dciodvfy, source_of
from tests.support.photo_files import bomb, pattern, written

SECRETS = (b"Exif", b"GPS", b"TheHospital", b"SecretPhone", b"http://ns.adobe.com", b"ftypmp4")


def photo_of(path: Path, folder: Path) -> Dataset:
    """The object of a photo, read back; dciodvfy finds no error in it."""
    header = Header(StudyContext(), source_of(path.parent, {}))
    made = write_photo(header, path, 1, folder / "photo.dcm")
    assert dciodvfy(made.made.path) == []
    return dcmread(made.made.path)


def shown(dataset: Dataset) -> NDArray[np.uint8]:
    """The picture (H, W, 3) as libjpeg decodes the frame."""
    (frame,) = frames(dataset)
    with Image.open(io.BytesIO(frame)) as opened:
        assert not opened.getexif()
        return np.asarray(opened.convert("RGB"))


def apart(picture: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Mean difference of two pictures (H, W, 3) in blocks of 8 x 8 pixels: coding blurs the colours of finer detail."""
    small = [
        np.asarray(Image.fromarray(p).resize((p.shape[1] // 8, p.shape[0] // 8), Image.Resampling.BOX), float)
        for p in (picture, other)
    ]
    return float(np.abs(small[0] - small[1]).mean())


def frames(dataset: Dataset) -> list[bytes]:
    from pydicom.encaps import generate_frames

    return list(generate_frames(dataset.PixelData, number_of_frames=1))


def with_secrets(path: Path, image: NDArray[np.uint8], **options: Any) -> Path:
    """A phone's JPEG with GPS, a comment, XMP, and a film behind its end."""
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "SecretPhone"
    exif[ExifTags.Base.ImageDescription] = "TheHospital"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] = (45.0, 27.0, 50.0)
    out = io.BytesIO()
    Image.fromarray(image).save(
        out,
        "JPEG",
        quality=90,
        exif=exif,
        comment=b"TheHospital",
        xmp=b"<x>http://ns.adobe.com TheHospital</x>",
        **options,
    )
    path.write_bytes(out.getvalue() + b"\x00\x00\x00\x18ftypmp42TheHospital")
    return path


def test_a_baseline_jpeg_is_kept_as_it_was_coded(tmp_path: Path) -> None:
    path = with_secrets(tmp_path / "a.jpg", pattern())
    photo = photo_of(path, tmp_path / "out")
    assert photo.ImageType == ["ORIGINAL", "PRIMARY"]
    assert "DerivationDescription" not in photo
    (frame,) = frames(photo)
    # The scan, byte for byte: from its start to the end of the picture.
    original = path.read_bytes()
    scan = original[original.index(b"\xff\xda") : original.index(b"\xff\xd9", original.index(b"\xff\xda")) + 2]
    assert len(scan) > 1000
    assert scan in frame
    with Image.open(path) as opened:
        np.testing.assert_array_equal(shown(photo), np.asarray(opened.convert("RGB")))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_gps_and_all_else_are_gone_and_the_photo_is_upright(tmp_path: Path, orientation: int) -> None:
    upright = pattern(96, 64)
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),
        7: upright.transpose(1, 0, 2)[::-1, ::-1],
        8: np.rot90(upright, -1),
    }[orientation]
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.Make] = "SecretPhone"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] = (45.0, 27.0, 50.0)
    path = tmp_path / "TheHospital.jpg"
    Image.fromarray(np.ascontiguousarray(stored)).save(path, "JPEG", quality=97, exif=exif)
    assert b"SecretPhone" in path.read_bytes()
    photo = photo_of(path, tmp_path / "out")
    assert (photo.Rows, photo.Columns) == (64, 96)
    assert apart(shown(photo), upright) < 1.0
    assert photo.ImageType[0] == ("ORIGINAL" if orientation == 1 else "DERIVED")
    whole = (tmp_path / "out" / "photo.dcm").read_bytes()
    assert not [secret for secret in SECRETS if secret in whole]


def test_what_stands_behind_and_beside_the_picture_is_gone(tmp_path: Path) -> None:
    path = with_secrets(tmp_path / "a.jpg", pattern())
    assert all(secret in path.read_bytes() for secret in (b"Exif", b"SecretPhone", b"TheHospital", b"ftypmp4"))
    photo_of(path, tmp_path / "out")
    whole = (tmp_path / "out" / "photo.dcm").read_bytes()
    assert not [secret for secret in SECRETS if secret in whole]


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("PNG", {}),
        ("HEIF", {}),
        ("WEBP", {}),
        ("TIFF", {}),
        ("BMP", {}),
        ("JPEG", {"progressive": True}),
        ("MPO", {}),
    ],
)
def test_formats_become_a_baseline_jpeg(tmp_path: Path, kind: str, options: dict[str, Any]) -> None:
    image = pattern(120, 80)
    path = written(tmp_path / f"a.{kind.lower()}", image, kind, **options)
    photo = photo_of(path, tmp_path / "out")
    assert (photo.Rows, photo.Columns) == (80, 120)
    (frame,) = frames(photo)
    assert b"\xff\xc0" in frame
    assert b"\xff\xc2" not in frame
    assert apart(shown(photo), image) < 1.0
    assert photo.LossyImageCompression == "01"
    assert photo.PhotometricInterpretation == "YBR_FULL_422"


def test_grey_and_cmyk_jpegs(tmp_path: Path) -> None:
    image = Image.fromarray(pattern())
    image.convert("L").save(tmp_path / "grey.jpg", quality=95)
    grey = photo_of(tmp_path / "grey.jpg", tmp_path / "out")
    assert (grey.PhotometricInterpretation, grey.SamplesPerPixel) == ("MONOCHROME2", 1)
    assert grey.ImageType[0] == "ORIGINAL"
    image.convert("CMYK").save(tmp_path / "cmyk.jpg", quality=95)
    cmyk = photo_of(tmp_path / "cmyk.jpg", tmp_path / "out")
    assert (cmyk.SamplesPerPixel, cmyk.ImageType[0]) == (3, "DERIVED")
    assert apart(shown(cmyk), pattern()) < 1.0


def test_a_jpeg_whose_colours_are_rgb_is_coded_anew(tmp_path: Path) -> None:
    image = pattern()
    Image.fromarray(image).save(tmp_path / "rgb.jpg", quality=95, keep_rgb=True)
    assert baseline_frame((tmp_path / "rgb.jpg").read_bytes()) is None
    photo = photo_of(tmp_path / "rgb.jpg", tmp_path / "out")
    assert photo.ImageType[0] == "DERIVED"
    assert apart(shown(photo), image) < 1.0


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_phones_twelve_megapixels(tmp_path: Path, orientation: int) -> None:
    small = Image.fromarray(pattern(400, 300))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    small.resize((4032, 3024)).save(tmp_path / "big.jpg", quality=85, exif=exif)
    photo = photo_of(tmp_path / "big.jpg", tmp_path / "out")
    assert (photo.Columns, photo.Rows) == ((4032, 3024) if orientation == 1 else (3024, 4032))
    assert shown(photo).shape[:2] == (photo.Rows, photo.Columns)


def test_the_profile_of_the_colours_is_kept(tmp_path: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    cases: dict[str, dict[str, Any]] = {"kept.jpg": {}, "anew.jpg": {"progressive": True}, "anew.png": {}}
    for name, options in cases.items():
        path = tmp_path / name
        Image.fromarray(pattern()).save(path, icc_profile=profile, **options)
        assert bytes(photo_of(path, tmp_path / "out").ICCProfile)[: len(profile)] == profile


def test_a_profile_that_is_none_is_left_out(tmp_path: Path) -> None:
    Image.fromarray(pattern()).save(tmp_path / "a.jpg", icc_profile=b"TheHospital" * 40)
    assert "ICCProfile" not in photo_of(tmp_path / "a.jpg", tmp_path / "out")
    assert rgb_profile(None) is None
    assert rgb_profile(struct.pack(">I", 200) + bytes(196)) is None


@pytest.mark.parametrize("share", [0.3, 0.9])
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_a_photo_that_is_cut_off_is_refused(tmp_path: Path, kind: str, share: float) -> None:
    path = written(tmp_path / "a", pattern(), kind)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(PhotoUnreadableError):
        photo_frame(path)


def test_what_is_no_photo_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"\xff\xd8\xff", b"%!PS-Adobe\n", b"\xff\xd8" + b"\xff" * 5000):
        (tmp_path / "a.jpg").write_bytes(content)
        with pytest.raises(PhotoUnreadableError):
            photo_frame(tmp_path / "a.jpg")


def test_a_picture_that_swells_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    with pytest.raises(PhotoUnreadableError):
        photo_frame(bomb(tmp_path / "a.png"))
    with pytest.raises(PhotoTooLargeError):
        photo_frame(bomb(tmp_path / "b.png", side=12000))


def test_no_prefix_of_a_jpeg_stops_the_parser() -> None:
    out = io.BytesIO()
    Image.fromarray(pattern(40, 30)).save(out, "JPEG")
    whole = out.getvalue()
    assert baseline_frame(whole) is not None
    found = [baseline_frame(whole[:end]) for end in range(len(whole) - 2)]
    assert found == [None] * len(found)


def test_damaged_bytes_do_not_stop_the_parser() -> None:
    out = io.BytesIO()
    Image.fromarray(pattern(40, 30)).save(out, "JPEG")
    rng = np.random.default_rng(5)
    for _ in range(2000):
        data = bytearray(out.getvalue())
        for at in rng.integers(0, len(data), 3):
            data[at] = int(rng.integers(0, 256))
        frame = baseline_frame(bytes(data))
        assert frame is None or frame.data.startswith(b"\xff\xd8\xff\xe0")

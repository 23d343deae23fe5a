"""Photos as VL Photographic Images: the phone's own JPEG where it can stand in DICOM, upright, without EXIF."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image
from pydicom import Dataset
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence
from pydicom.uid import JPEGBaseline8Bit, VLPhotographicImageStorage

from specimap_core.errors import PhotoTooLargeError
from specimap_core.photos.decoding import LARGEST_PHOTO_PIXELS, check_pixels, decode_photo, set_up_pillow
from specimap_core.photos.formats import FORMATS
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import PHOTOS, Header, ds
from specimap_hospital.dicom.jpeg import Frame, baseline_frame, rgb_profile

QUALITY = 95
"""Of a photo that has to be coded anew."""
MOST_WHOLE_PIXELS = 100_000_000
"""Pixels of a photo that has to be decoded whole: 0.3 GB."""
_CHECKED_PX = 256
"""A photo that is kept is decoded at about this size, to learn whether it is whole."""
_LARGEST_SIDE = 65535
_TURNED = range(2, 9)
"""EXIF orientations that are not upright."""


@dataclass(frozen=True)
class PhotoFrame:
    """A frame, and whether it is the phone's own."""

    frame: Frame
    kept: bool


def photo_frame(path: Path) -> PhotoFrame:
    """The photo as a baseline JPEG, upright, without metadata.

    A baseline JPEG that stands upright is kept as it was coded; all else is decoded, turned upright, and coded anew.

    Raises:
        PhotoUnreadableError: it does not decode, is a raw file, or has too many pixels.
    """
    check_pixels(path, MOST_WHOLE_PIXELS)
    kept = _kept_frame(path)
    if kept is not None:
        return PhotoFrame(kept, True)
    decoded = decode_photo(path, LARGEST_PHOTO_PIXELS)
    height, width = decoded.pixels.shape[:2]
    if width * height > MOST_WHOLE_PIXELS or max(width, height) > _LARGEST_SIDE:
        raise PhotoTooLargeError(
            f"The photo has {width} x {height} pixels, too many to be coded anew for DICOM.",
            advice="Take photos of at most 100 million pixels.",
            limit_pixels=MOST_WHOLE_PIXELS,
        )
    coded = io.BytesIO()
    Image.fromarray(decoded.pixels).save(coded, "JPEG", quality=QUALITY, subsampling="4:2:2")
    frame = baseline_frame(coded.getvalue())
    assert frame is not None
    return PhotoFrame(Frame(frame.data, width, height, frame.components, _profile(path)), False)


def _kept_frame(path: Path) -> Frame | None:
    set_up_pillow()
    with Image.open(path, formats=tuple(FORMATS)) as opened:
        if opened.format not in ("JPEG", "MPO") or opened.getexif().get(ExifTags.Base.Orientation, 1) in _TURNED:
            return None
    frame = baseline_frame(path.read_bytes())
    if frame is not None:
        # What cannot be decoded is refused here, and not by the viewer.
        decode_photo(path, _CHECKED_PX)
    return frame


def _profile(path: Path) -> bytes | None:
    """The colours' profile of a file of any format."""
    with Image.open(path, formats=tuple(FORMATS)) as opened:
        return rgb_profile(opened.info.get("icc_profile"))


def write_photo(header: Header, path: Path, number: int, target: Path) -> Written:
    """Write a photo as the object ``target``.

    Raises:
        PhotoUnreadableError: as :func:`photo_frame`.
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    found = photo_frame(path)
    return write_dataset(header, photo_dataset(header, found, number), "photo", target, JPEGBaseline8Bit)


def photo_dataset(header: Header, found: PhotoFrame, number: int) -> Dataset:
    """The object of a photo's frame."""
    frame = found.frame
    image = header.image(PHOTOS, VLPhotographicImageStorage, f"photo-{number}", number)
    image.AcquisitionContextSequence = Sequence()
    image.ImageType = ["ORIGINAL" if found.kept else "DERIVED", "PRIMARY"]
    if not found.kept:
        image.DerivationDescription = f"Turned upright and coded anew as JPEG, quality {QUALITY}"
    image.Rows, image.Columns = frame.height, frame.width
    image.SamplesPerPixel = frame.components
    if frame.components == 3:
        image.PhotometricInterpretation, image.PlanarConfiguration = "YBR_FULL_422", 0
    else:
        image.PhotometricInterpretation = "MONOCHROME2"
    image.BitsAllocated, image.BitsStored, image.HighBit, image.PixelRepresentation = 8, 8, 7, 0
    image.LossyImageCompression = "01"
    image.LossyImageCompressionMethod = "ISO_10918_1"
    image.LossyImageCompressionRatio = ds(
        round(frame.width * frame.height * frame.components / max(len(frame.data), 1), 2)
    )
    if frame.icc is not None:
        image.ICCProfile = frame.icc + b"\x00" * (len(frame.icc) % 2)
    image.PixelData = encapsulate([frame.data])
    return image

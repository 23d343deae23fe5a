"""Top view and spectral preview as Secondary Capture, in mm. A plane would be taken for one of the patient."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydicom import Dataset
from pydicom.uid import ExplicitVRLittleEndian, SecondaryCaptureImageStorage

from specimap_core.errors import CloudDamagedError
from specimap_hospital.dicom.canvas import Canvas
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import PREVIEW, TOP_VIEW, Header, Series, ds
from specimap_hospital.dicom.model import Kind

CALIBRATION = "Edge of the printed markers"
DERIVATIONS = {
    "top_view": "Point cloud from above, marker frame, colours of the photos",
    "preview": "Point cloud from above, marker frame, first three principal components of its spectra",
}


def write_picture(header: Header, kind: Kind, picture: NDArray[np.uint8], canvas: Canvas, target: Path) -> Written:
    """Write a picture (rows, cols, 3) of the canvas as the object ``target``; ``kind``: ``top_view`` or ``preview``.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    series: Series = TOP_VIEW if kind == "top_view" else PREVIEW
    image = header.image(series, SecondaryCaptureImageStorage, series.role, 1)
    image.ImageType = ["DERIVED", "SECONDARY"]
    image.ConversionType = "WSD"
    image.DerivationDescription = DERIVATIONS[kind]
    put_spacing(image, canvas)
    put_rgb(image, picture)
    return write_dataset(header, image, kind, target, ExplicitVRLittleEndian)


def put_spacing(image: Dataset, canvas: Canvas) -> None:
    """Say how large a pixel is, and how that is known."""
    image.PixelSpacing = [ds(canvas.grid_mm), ds(canvas.grid_mm)]
    image.PixelSpacingCalibrationType = "FIDUCIAL"
    image.PixelSpacingCalibrationDescription = CALIBRATION


def put_rgb(image: Dataset, picture: NDArray[np.uint8]) -> None:
    """Set the pixels (rows, cols, 3) of an image, as they are."""
    rows, cols = picture.shape[:2]
    pixels = np.ascontiguousarray(picture).tobytes()
    for name, value in {
        "Rows": rows,
        "Columns": cols,
        "SamplesPerPixel": 3,
        "PhotometricInterpretation": "RGB",
        "PlanarConfiguration": 0,
        "BitsAllocated": 8,
        "BitsStored": 8,
        "HighBit": 7,
        "PixelRepresentation": 0,
        "PixelData": pixels + b"\x00" * (len(pixels) % 2),
    }.items():
        setattr(image, name, value)


def read_preview(path: Path) -> NDArray[np.uint8]:
    """A run's ``preview.png`` (H, W, 4).

    Raises:
        CloudDamagedError: it does not decode.
    """
    try:
        with Image.open(path, formats=("PNG",)) as opened:
            return np.asarray(opened.convert("RGBA"))
    except (OSError, ValueError, SyntaxError) as error:
        raise CloudDamagedError(
            "preview.png does not decode.", advice="Repeat the run.", array="preview.png"
        ) from error

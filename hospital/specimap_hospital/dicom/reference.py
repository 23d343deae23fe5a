"""The reference image of maps and segmentations: a top view that has a plane, the marker frame's.

Viewers lay maps on images of one plane only. They may draw the letters of a patient's axes on it, which are false for
an excised specimen; so the first set has no such image, and this one says what its axes are.
"""

from __future__ import annotations

from pathlib import Path

from pydicom import Dataset
from pydicom.uid import ExplicitVRLittleEndian, SecondaryCaptureImageStorage

from specimap_hospital.dicom.canvas import Canvas
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import RESEARCH, Header, Series, ds
from specimap_hospital.dicom.pictures import put_rgb, put_spacing
from specimap_hospital.dicom.result import Result

REFERENCE = Series("reference", 8, "OT", f"Marker frame, not patient axes ({RESEARCH})")
COMMENT = "Axes are those of the printed markers (x right, y up), not of the patient"


def write_reference(header: Header, result: Result, target: Path) -> Written:
    """Write the reference image of a result as the object ``target``.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    canvas = result.canvas
    image = header.image(REFERENCE, SecondaryCaptureImageStorage, REFERENCE.role, 1)
    image.ImageType = ["DERIVED", "SECONDARY"]
    image.ConversionType = "WSD"
    image.DerivationDescription = COMMENT
    image.ImageComments = COMMENT
    put_spacing(image, canvas)
    _put_plane(header, image, canvas)
    put_rgb(image, canvas.rgb(result.cloud))
    written = write_dataset(header, image, "reference_image", target, ExplicitVRLittleEndian)
    # What lies on it states a thickness, though a surface has none.
    written.dataset.SliceThickness = ds(canvas.grid_mm)
    return written


def _put_plane(header: Header, image: Dataset, canvas: Canvas) -> None:
    """Rows run along x, columns against y, at z = 0, in mm."""
    x, y = canvas.first_pixel_mm
    image.FrameOfReferenceUID, image.PositionReferenceIndicator = header.frame_of_reference_uid, ""
    image.ImageOrientationPatient = [1, 0, 0, 0, -1, 0]
    image.ImagePositionPatient = [ds(x), ds(y), 0]

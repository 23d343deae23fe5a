"""A label layer of classes as a Segmentation, on the grid of the top view."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import highdicom as hd
import numpy as np
from pydicom import Dataset
from pydicom.uid import ExplicitVRLittleEndian

from specimap_core.errors import NotFoundError, SettingsError
from specimap_hospital.dicom import codes
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import MANUFACTURER, NO_SERIAL_NUMBER, RESEARCH, Header, Series
from specimap_hospital.dicom.model import SegmentClass
from specimap_hospital.dicom.result import Result

_NUMBER = 10
_MEANING = 64


def write_segmentation(
    header: Header, result: Result, label: str, classes: Sequence[SegmentClass], reference: Dataset, target: Path
) -> Written:
    """Write the classes of a layer as the object ``target``, on the reference image; a segment for each class.

    Raises:
        NotFoundError: the cloud has no such layer, or no pixel shows one of the classes.
        SettingsError: no class is given, or the layer holds probabilities.
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    values = result.cloud.label(label)
    if values.dtype.kind == "f":
        raise SettingsError(
            f"The layer {label} holds probabilities.", advice="Ask for a parametric map of it.", setting="label"
        )
    if not classes:
        raise SettingsError("No class is chosen.", advice="Name the classes of the layer.", setting="classes")
    on_grid = result.canvas.classes(values, np.argsort(-result.cloud.xyz[:, 2], kind="stable"))
    segments = np.zeros(on_grid.shape, np.uint16)
    for number, item in enumerate(classes, 1):
        segments[result.canvas.covered & (on_grid == item.value)] = number
    if not segments.any():
        raise NotFoundError(f"No pixel of the layer {label} shows one of the classes.", advice="Name other classes.")
    # A layer that is written anew under its name is another object.
    role = f"segmentation-{label}-{hashlib.sha256(segments.tobytes() + repr(classes).encode()).hexdigest()}"
    series = Series(role, _NUMBER, "SEG", f"Classes, marker frame, not patient axes ({RESEARCH})")
    found = hd.seg.Segmentation(
        source_images=[reference],
        pixel_array=segments[None],
        segmentation_type=hd.seg.SegmentationTypeValues.BINARY,
        segment_descriptions=[_segment(number, item, header) for number, item in enumerate(classes, 1)],
        series_instance_uid=header.series_uid(series),
        series_number=series.number,
        sop_instance_uid=header.instance_uid(role),
        instance_number=1,
        manufacturer=MANUFACTURER,
        manufacturer_model_name=MANUFACTURER,
        software_versions=header.source.software_version,
        device_serial_number=NO_SERIAL_NUMBER,
        transfer_syntax_uid=ExplicitVRLittleEndian,
        content_label="SPECIMAP_CLASSES",
        content_description=f"Marker frame, not patient axes; {RESEARCH}",
    )
    header.put(found, series, role, 1)
    header.put_specimen(found)
    return write_dataset(header, found, "segmentation", target, ExplicitVRLittleEndian)


def _segment(number: int, item: SegmentClass, header: Header) -> hd.seg.SegmentDescription:
    colour = None
    if item.colour:
        red, green, blue = (int(item.colour[k : k + 2], 16) for k in (1, 3, 5))
        colour = hd.color.CIELabColor.from_rgb(red, green, blue)
    return hd.seg.SegmentDescription(
        segment_number=number,
        segment_label=item.name[:_MEANING],
        segmented_property_category=codes.CONCEPT,
        segmented_property_type=codes.own(f"class_{item.value}", item.name[:_MEANING]),
        algorithm_type=hd.seg.SegmentAlgorithmTypeValues.SEMIAUTOMATIC,
        algorithm_identification=hd.AlgorithmIdentificationSequence(
            "Label layer of the cloud", codes.CLASSIFICATION, header.source.software_version
        ),
        display_color=colour,
    )

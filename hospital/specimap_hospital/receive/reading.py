"""Reads DICOM objects that came in, and puts a segmentation onto the points of a cloud. Runs in a confined process."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom import Dataset, dcmread
from pydicom.encaps import generate_frames
from pydicom.filereader import read_file_meta_info

from specimap_core.cloud import Cloud
from specimap_hospital.orders.mapping import order_of
from specimap_hospital.receive.classes import (
    CANNOT_PROCESS,
    CANNOT_UNDERSTAND,
    JPEG,
    NOT_SUPPORTED,
    PHOTOS,
    PLAIN,
    SEGMENTATIONS,
)

MOST_SIDE = 20_000
MOST_PIXELS = 1 << 28
MOST_SEGMENTS = 255
MOST_REFERENCES = 1000
PLACE_SHARE = 0.01
"""Of a pixel: how far the plane of a segmentation may lie from the pixels of the picture that it refers to."""


class RefusedError(Exception):
    """An object that is not taken: the code of the failure."""

    def __init__(self, failure: int) -> None:
        super().__init__(f"{failure:04x}")
        self.failure = failure


def read(path: Path, out: Path) -> dict[str, Any]:
    """Read an object. Returns what it is as JSON values; labels (rows, cols) and photos are written next to ``out``.

    Raises:
        RefusedError: it is not taken.
    """
    warnings.simplefilter("ignore")
    # Before the rest is read: what is deflated would be inflated as a whole.
    syntax = str(read_file_meta_info(path).TransferSyntaxUID)
    if syntax not in (*PLAIN, JPEG):
        raise RefusedError(NOT_SUPPORTED)
    dataset = dcmread(path)
    found: dict[str, Any] = {
        "sop_class_uid": str(dataset.SOPClassUID),
        "sop_instance_uid": str(dataset.SOPInstanceUID),
    }
    if dataset.SOPClassUID in SEGMENTATIONS:
        return {**found, **_segmentation(dataset, syntax, out)}
    if dataset.SOPClassUID in PHOTOS:
        return {**found, **_photo(dataset, syntax, out)}
    raise RefusedError(NOT_SUPPORTED)


# ---- photos -------------------------------------------------------------------------------------------


def _photo(dataset: Dataset, syntax: str, out: Path) -> dict[str, Any]:
    if int(dataset.get("NumberOfFrames") or 1) != 1:
        raise RefusedError(NOT_SUPPORTED)
    if syntax == JPEG:
        (frame,) = generate_frames(dataset.PixelData, number_of_frames=1)
        out.with_suffix(".jpg").write_bytes(frame)
        name = out.with_suffix(".jpg").name
    elif syntax in PLAIN:
        _check_size(dataset, 1)
        if dataset.SamplesPerPixel != 3 or dataset.BitsAllocated != 8 or dataset.PhotometricInterpretation != "RGB":
            raise RefusedError(NOT_SUPPORTED)
        from PIL import Image

        Image.fromarray(np.asarray(dataset.pixel_array)).save(out.with_suffix(".png"))
        name = out.with_suffix(".png").name
    else:
        raise RefusedError(NOT_SUPPORTED)
    order = order_of(dataset, "qido")
    return {
        "kind": "photo",
        "file": name,
        "study_uid": str(dataset.StudyInstanceUID),
        "study": None if order is None else order.study.model_dump(mode="json"),
    }


def _check_size(dataset: Dataset, frames: int) -> None:
    rows, cols = int(dataset.Rows), int(dataset.Columns)
    if not (0 < rows <= MOST_SIDE and 0 < cols <= MOST_SIDE and rows * cols * frames <= MOST_PIXELS):
        raise RefusedError(CANNOT_PROCESS)


# ---- segmentations ------------------------------------------------------------------------------------


def _segmentation(dataset: Dataset, syntax: str, out: Path) -> dict[str, Any]:
    kind, frames = str(dataset.SegmentationType), int(dataset.get("NumberOfFrames") or 1)
    segments = list(dataset.SegmentSequence)
    if kind not in ("BINARY", "LABELMAP") or syntax not in PLAIN:
        raise RefusedError(NOT_SUPPORTED)
    if not 0 < frames <= MOST_SEGMENTS or not 0 < len(segments) <= MOST_SEGMENTS + 1:
        raise RefusedError(CANNOT_PROCESS)
    _check_size(dataset, frames)
    pixels = np.asarray(dataset.pixel_array).reshape(frames, int(dataset.Rows), int(dataset.Columns))
    if kind == "LABELMAP":
        if frames != 1:
            raise RefusedError(CANNOT_PROCESS)
        labels = pixels[0].astype(np.uint16)
    else:
        labels = _joined(dataset, pixels)
    known = {int(item.SegmentNumber): _name(item) for item in segments if int(item.SegmentNumber) > 0}
    if not set(np.unique(labels).tolist()) <= {0, *known} or max(known, default=0) > 65535:
        raise RefusedError(CANNOT_UNDERSTAND)
    np.save(out.with_suffix(".npy"), labels)
    return {
        "kind": "segmentation",
        "file": out.with_suffix(".npy").name,
        "name": str(dataset.get("ContentLabel") or dataset.get("SeriesDescription") or ""),
        "maker": str(dataset.get("ManufacturerModelName") or dataset.get("Manufacturer") or ""),
        "version": str(dataset.get("SoftwareVersions") or "")[:200],
        "segments": known,
        "references": sorted(_references(dataset))[:MOST_REFERENCES],
        "place": _place(dataset),
    }


def _joined(dataset: Dataset, pixels: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """The segment of each pixel; 0 where there is none."""
    labels = np.zeros(pixels.shape[1:], np.uint16)
    for frame, groups in zip(pixels, dataset.PerFrameFunctionalGroupsSequence, strict=True):
        shared = (dataset.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]
        owner = groups if "SegmentIdentificationSequence" in groups else shared
        inside = frame > 0
        if labels[inside].any():
            # A point has one class.
            raise RefusedError(CANNOT_PROCESS)
        labels[inside] = int(owner.SegmentIdentificationSequence[0].ReferencedSegmentNumber)
    return labels


def _name(segment: Dataset) -> str:
    return str(segment.get("SegmentLabel") or segment.get("SegmentDescription") or segment.SegmentNumber)[:100]


def _references(dataset: Dataset) -> set[str]:
    """SOP Instance UIDs of all images that it names as its sources."""
    found = {
        str(item.ReferencedSOPInstanceUID)
        for series in dataset.get("ReferencedSeriesSequence") or ()
        for item in series.get("ReferencedInstanceSequence") or ()
    }
    for name in ("PerFrameFunctionalGroupsSequence", "SharedFunctionalGroupsSequence"):
        for groups in dataset.get(name) or ():
            for derivation in groups.get("DerivationImageSequence") or ():
                for item in derivation.get("SourceImageSequence") or ():
                    found.add(str(item.ReferencedSOPInstanceUID))
    return found


def _place(dataset: Dataset) -> list[list[float]] | None:
    """Position and orientation of its plane, where it has one; all frames have the same."""
    places = []
    shared = (dataset.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]
    for groups in dataset.get("PerFrameFunctionalGroupsSequence") or ():
        position, turned = (
            next((each.get(name) for each in (groups, shared) if each.get(name)), None)
            for name in ("PlanePositionSequence", "PlaneOrientationSequence")
        )
        if position and turned:
            places.append(
                [
                    [float(value) for value in position[0].ImagePositionPatient],
                    [float(value) for value in turned[0].ImageOrientationPatient],
                ]
            )
    if any(place != places[0] for place in places):
        raise RefusedError(CANNOT_PROCESS)
    return places[0] if places else None


def on_points(
    cloud: Cloud, corners: NDArray[np.float64], labels: NDArray[np.uint16], place: list[list[float]] | None
) -> NDArray[np.uint16]:
    """The segment of each point (S,) of a cloud, from those of the pixels of its top view; 0: unlabelled.

    A pixel's segment is that of the points that the pixel shows: those of its cell that are seen from above. Points
    under them, which the picture does not show, stay unlabelled.

    Args:
        corners: of the markers (Q, 4, 3), mm.
        place: position and orientation of the plane, as the reference image has them.

    Raises:
        RefusedError: the pixels are not those of the cloud's top view.
    """
    from specimap_hospital.dicom.canvas import Canvas

    canvas = Canvas.of(cloud, corners)
    if labels.shape != (canvas.rows, canvas.cols):
        raise RefusedError(CANNOT_PROCESS)
    if place is not None:
        expected = [[*canvas.first_pixel_mm, 0.0], [1.0, 0.0, 0.0, 0.0, -1.0, 0.0]]
        for found, wanted in zip(place, expected, strict=True):
            if not np.allclose(found, wanted, rtol=0, atol=PLACE_SHARE * canvas.grid_mm):
                raise RefusedError(CANNOT_PROCESS)
    row = canvas.rows - 1 - (canvas.view.cell // canvas.view.cols + canvas.below)
    col = canvas.view.cell % canvas.view.cols + canvas.left
    return np.where(canvas.view.top, labels[row, col], np.uint16(0)).astype(np.uint16)

"""A key object selection: what to look at first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import highdicom as hd
from pydicom.uid import ExplicitVRLittleEndian

from specimap_hospital.dicom import codes
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import KEY_OBJECTS, MANUFACTURER, Header

DESCRIPTION = "Top view, spectral preview and accuracy figures of the specimen. Research use only."


def write_key_objects(header: Header, chosen: Sequence[Written], target: Path) -> Written:
    """Write a selection of objects as the object ``target``.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    evidence = [written.dataset for written in chosen]
    selection = hd.ko.KeyObjectSelectionDocument(
        evidence=evidence,
        content=hd.ko.KeyObjectSelection(
            document_title=codes.OF_INTEREST, referenced_objects=evidence, description=DESCRIPTION
        ),
        series_instance_uid=header.series_uid(KEY_OBJECTS),
        series_number=KEY_OBJECTS.number,
        sop_instance_uid=header.instance_uid(KEY_OBJECTS.role),
        instance_number=1,
        manufacturer=MANUFACTURER,
        transfer_syntax_uid=ExplicitVRLittleEndian,
    )
    for item in selection.ContentSequence:
        # Its template allows a name on text alone; the library names the references, too.
        if item.ValueType in ("IMAGE", "COMPOSITE"):
            del item.ConceptNameCodeSequence
    header.put(selection, KEY_OBJECTS, KEY_OBJECTS.role, 1)
    return write_dataset(header, selection, "key_objects", target, ExplicitVRLittleEndian)

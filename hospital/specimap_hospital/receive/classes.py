"""What is taken in: classes of objects, and the syntaxes of their pixels. Light: it loads no DICOM library."""

from __future__ import annotations

SEGMENTATIONS = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
"""Segmentation, Label Map Segmentation."""
PHOTOS = ("1.2.840.10008.5.1.4.1.1.77.1.4", "1.2.840.10008.5.1.4.1.1.7")
"""VL Photographic Image, Secondary Capture Image."""
JPEG = "1.2.840.10008.1.2.4.50"
PLAIN = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.5")
"""Little endian, and RLE: pixels that need no decoder of others. A deflated object is not taken."""
NOT_SUPPORTED, CANNOT_UNDERSTAND, CANNOT_PROCESS = 0x0122, 0xC000, 0x0110
NO_SUCH_OBJECT, NOT_AUTHORISED, OUT_OF_RESOURCES = 0x0112, 0x0124, 0xA700
"""Codes of failures."""

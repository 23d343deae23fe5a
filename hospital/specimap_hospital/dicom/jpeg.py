"""A photo's JPEG as a DICOM frame: the coded picture as the phone made it, without anything that stands beside it.

EXIF, GPS, comments, previews and further pictures are left out; the coded picture is copied byte for byte.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

_SOI, _EOI, _SOS, _SOF0, _COM = 0xD8, 0xD9, 0xDA, 0xC0, 0xFE
_APP0, _APP2, _APP14, _APP15 = 0xE0, 0xE2, 0xEE, 0xEF
_OTHER_FRAMES = {*range(0xC1, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""SOF1 to SOF15 without DHT, JPG and DAC: extended, progressive, lossless, arithmetic."""
_JFIF = b"\xff\xe0\x00\x10JFIF\x00\x01\x01\x00\x00\x01\x00\x01\x00\x00"
_ICC = b"ICC_PROFILE\x00"
LARGEST_PROFILE = 1 << 20


@dataclass(frozen=True)
class Frame:
    """A baseline JPEG without metadata; ``components`` 1 (grey) or 3 (YCbCr); ``icc``: the profile that stood in it."""

    data: bytes
    width: int
    height: int
    components: int
    icc: bytes | None


def baseline_frame(data: bytes) -> Frame | None:
    """The frame of a file that is a baseline JPEG, grey or YCbCr; None where it is not, or not whole."""
    try:
        return _frame(data)
    except (IndexError, struct.error):
        return None


def _frame(data: bytes) -> Frame | None:
    if data[:2] != bytes([0xFF, _SOI]):
        return None
    kept, at = [data[:2], _JFIF], 2
    size: tuple[int, int] | None = None
    ids, adobe, jfif = b"", None, False
    profile: dict[int, bytes] = {}
    while True:
        if data[at] != 0xFF:
            return None
        while data[at + 1] == 0xFF:  # fill bytes
            at += 1
        marker = data[at + 1]
        if marker == _EOI:
            break
        if marker in _OTHER_FRAMES:
            return None
        (length,) = struct.unpack_from(">H", data, at + 2)
        body = data[at + 4 : at + 2 + length]
        if length < 2 or len(body) != length - 2:
            return None
        if marker == _APP0:
            jfif = jfif or body.startswith(b"JFIF\x00")
        elif marker == _APP2 and body.startswith(_ICC):
            profile[body[len(_ICC)]] = body[len(_ICC) + 2 :]
        elif marker == _APP14 and body.startswith(b"Adobe"):
            adobe = body[11]
        if marker == _SOF0:
            precision, height, width, components = struct.unpack_from(">BHHB", body)
            ids = body[6 : 6 + 3 * components : 3]
            size = (width, height)
            if precision != 8 or components not in (1, 3) or 0 in size:
                return None
        end = at + 2 + length
        if marker == _SOS:
            end = _end_of_scan(data, end)
        if not (_APP0 <= marker <= _APP15 or marker == _COM):
            kept.append(data[at:end])
        at = end
    if size is None or not (len(ids) == 1 or _is_ycbcr(ids, adobe, jfif)):
        return None
    kept.append(bytes([0xFF, _EOI]))
    whole = b"".join(kept)
    return Frame(whole, *size, len(ids), rgb_profile(b"".join(profile[k] for k in sorted(profile)), len(ids)))


def _end_of_scan(data: bytes, at: int) -> int:
    """Where the coded data of a scan end: at the next marker that is no restart."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0:
            raise IndexError("the scan is cut off")
        following = data[at + 1]
        if following == 0 or 0xD0 <= following <= 0xD7:
            at += 2
        elif following == 0xFF:
            at += 1
        else:
            return at


def _is_ycbcr(ids: bytes, adobe: int | None, jfif: bool) -> bool:
    """Whether decoders take the three components for YCbCr, as libjpeg does; the frame then says so by its JFIF."""
    if jfif:
        return True
    return adobe == 1 if adobe is not None else ids != b"RGB"


def rgb_profile(profile: bytes | None, components: int = 3) -> bytes | None:
    """A colour profile that DICOM takes: of an RGB display, camera or scanner, of a plausible size; None for others."""
    if not profile or not 128 < len(profile) <= LARGEST_PROFILE or components != 3:
        return None
    whole = struct.unpack_from(">I", profile)[0] == len(profile) and profile[36:40] == b"acsp"
    return profile if whole and profile[16:20] == b"RGB " and profile[12:16] in (b"mntr", b"scnr", b"spac") else None

"""Identifiers planted wherever a client can put text, and a search for them in all that files hold."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pillow_heif
import zarr
from PIL import Image, ImageCms
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import ImageFileDirectory_v2

MARK = "Zqx7Kw"
"""Every planted text begins with it; nothing else does."""

PLANTED: set[str] = set()
"""Every text that this process has planted."""


def planted(place: str) -> str:
    """A text to plant, of its own for each place."""
    text = f"{MARK}-{place}-Doe^Jane"
    PLANTED.add(text)
    return text


def encodings(text: str) -> dict[str, bytes]:
    """How a text may stand in a file."""
    raw = text.encode()
    found = {
        "utf-8": raw,
        "lower": text.lower().encode(),
        "upper": text.upper().encode(),
        "utf-16-le": text.encode("utf-16-le"),
        "utf-16-be": text.encode("utf-16-be"),
        "utf-32": text.encode("utf-32-le"),
        "hex": raw.hex().encode(),
        "url": quote(text, safe="").encode(),
        "reversed": raw[::-1],
    }
    for shift in range(3):
        # Base64 of a text within other bytes depends on where it begins; its middle does not.
        found[f"base64-{shift}"] = base64.b64encode(b"\0" * shift + raw)[4:-4]
    # A short one would be found in any file.
    return {name: form for name, form in found.items() if len(form) >= 6}


def places_of(texts: list[str], files: Iterator[tuple[str, bytes]]) -> set[tuple[str, str]]:
    """Each text with each file that holds it in some encoding."""
    wanted = [(text, form) for text in texts for form in encodings(text).values()]
    return {(text, name) for name, data in files for text, form in wanted if form in data}


def opened(name: str, data: bytes) -> Iterator[tuple[str, bytes]]:
    """A file's name, its bytes, and all that can be unpacked from them."""
    yield f"{name} (name)", name.encode()
    yield name, data
    if data[:4] == b"PK\3\4":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            yield f"{name} (comments)", archive.comment + b"".join(i.comment + i.extra for i in archive.infolist())
            for member in archive.namelist():
                yield from opened(f"{name}/{member}", archive.read(member))
    elif data[:8] == b"\x89PNG\r\n\x1a\n":
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()
            yield f"{name} (text)", repr(picture.info).encode() + repr(dict(picture.getexif())).encode()
            yield f"{name} (pixels)", picture.tobytes()
    elif data[:2] == b"\x1f\x8b":
        yield from opened(f"{name} (unzipped)", zlib.decompress(data, 31))
    elif data[:4] == b"%PDF":
        for part in data.split(b"stream\r\n")[1:] + data.split(b"stream\n")[1:]:
            try:
                yield f"{name} (stream)", zlib.decompressobj().decompress(part)
            except zlib.error:
                continue


def arrays_in(folder: Path) -> Iterator[tuple[str, bytes]]:
    """The values of all Zarr arrays in a folder, unpacked."""
    for document in folder.rglob("zarr.json"):
        if json.loads(document.read_text("utf-8")).get("node_type") == "array":
            yield str(document.parent), np.asarray(zarr.open_array(document.parent, mode="r")[...]).tobytes()


# ---- files that hold them -----------------------------------------------------------------------------


def exif_with(place: str) -> Image.Exif:
    exif = Image.Exif()
    for tag, name in {
        0x010E: "description",
        0x010F: "make",
        0x0110: "model",
        0x013B: "artist",
        0x8298: "copyright",
    }.items():
        exif[tag] = planted(f"{place}-{name}")
    detail = exif.get_ifd(0x8769)
    detail[0x9003] = "2026:11:01 10:11:12"
    detail[0x927C] = planted(f"{place}-maker").encode()
    detail[0x9286] = b"ASCII\0\0\0" + planted(f"{place}-comment").encode()
    detail[0xA431] = planted(f"{place}-serial")
    return exif


def _profile(place: str) -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes() + planted(f"{place}-icc").encode()


def _pixels(seed: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (96, 128, 3), np.uint8))


def photo(suffix: str) -> bytes:
    """A photo with identifiers in all places that its format has."""
    out, place = io.BytesIO(), suffix
    xmp = f"<x:xmpmeta xmlns:x='adobe:ns:meta/'><dc>{planted(f'{place}-xmp')}</dc></x:xmpmeta>".encode()
    picture = _pixels(len(suffix))
    if suffix == "jpg":
        iptc = planted(f"{place}-iptc").encode()
        remark = planted(f"{place}-com")
        picture.save(out, "JPEG", exif=exif_with(place), xmp=xmp, icc_profile=_profile(place), comment=remark)
        data = out.getvalue()
        record = b"\x1c\x02\x78\0" + bytes([len(iptc)]) + iptc
        resource = b"Photoshop 3.0\0" + b"8BIM\x04\x04\0\0" + struct.pack(">I", len(record)) + record
        segment = b"\xff\xed" + struct.pack(">H", len(resource) + 2) + resource
        # And something after the picture's end.
        return data[:2] + segment + data[2:] + planted(f"{place}-trailer").encode()
    if suffix == "png":
        info = PngInfo()
        info.add_text("Comment", planted(f"{place}-text"))
        info.add_text("Packed", planted(f"{place}-ztxt"), zip=True)
        info.add_itxt("XML:com.adobe.xmp", xmp.decode())
        picture.save(out, "PNG", pnginfo=info, exif=exif_with(place))
    elif suffix == "tif":
        tags = ImageFileDirectory_v2()
        for tag in (270, 305, 315, 316, 33432):
            tags[tag] = planted(f"{place}-{tag}")
        picture.save(out, "TIFF", tiffinfo=tags)
    else:
        pillow_heif.from_pillow(picture).save(out, exif=exif_with(place).tobytes(), xmp=xmp)
    return out.getvalue()


def envi_header(place: str) -> bytes:
    """Header of a cube of 6 x 5 pixels and 4 bands of uint16 with free text in all fields that have some."""
    text = "\n".join(
        [
            "ENVI",
            f"description = {{ {planted(f'{place}-description')} }}",
            "samples = 5",
            "lines = 6",
            "bands = 4",
            "header offset = 0",
            "file type = ENVI Standard",
            "data type = 12",
            "interleave = bil",
            "byte order = 0",
            f"sensor type = {planted(f'{place}-sensor')}",
            f"sensor serial = {planted(f'{place}-serial')}",
            f"operator = {planted(f'{place}-operator')}",
            "acquisition time = 2026-11-01T10:11:12Z",
            f"acquisition date = DATE(yyyy-mm-dd): {planted(f'{place}-date')}",
            f"band names = {{ {', '.join(planted(f'{place}-band{n}') for n in range(4))} }}",
            "wavelength units = Nanometers",
            "wavelength = { 500, 550, 600, 650 }",
            f"; {planted(f'{place}-remark')}",
        ]
    )
    return text.encode()


def cube_values() -> bytes:
    return np.arange(6 * 4 * 5, dtype="<u2").tobytes()

"""Read the wavelengths of a TIFF: from tifffile's JSON, GDAL's metadata, OME's channels, ENVI's own words."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import tifffile

from specimap_core.arrays import Floats
from specimap_core.cube.discover import Variable, choose_wavelengths

_GDAL_METADATA = 42112
_LONGEST = 16 << 20
_ITEM = re.compile(r"<Item\s([^>]*)>([^<]*)</Item>", re.IGNORECASE)
_ATTRIBUTE = re.compile(r"([\w-]+)\s*=\s*\"([^\"]*)\"")
_CHANNEL = re.compile(r"<(?:\w+:)?Channel\s([^>]*)>")
_NUMBER = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(.*?)\s*", re.DOTALL)


def named_wavelengths(file: tifffile.TiffFile) -> tuple[Floats | None, str | None]:
    """Wavelengths as the file writes them, in the order of its bands, and their unit's word; None where it has none."""
    for described in file.shaped_metadata or ():
        if isinstance(described, dict) and (found := _in_mapping(described)) is not None:
            return found
    page = file.pages.first
    for read, text in ((_in_gdal, _tag(page, _GDAL_METADATA)), (_in_description, _tag(page, 270))):
        if text and (found := read(text)) is not None:
            return found
    return None, None


def _tag(page: Any, code: int) -> str:
    tag = page.tags.get(code)
    value = None if tag is None else tag.value
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value if isinstance(value, str) and len(value) <= _LONGEST else ""


def _in_mapping(described: dict[str, Any]) -> tuple[Floats, str | None] | None:
    lists: dict[str, Floats] = {}
    variables = []
    for name, value in described.items():
        if isinstance(value, str):
            variables.append(Variable(str(name), (), np.dtype(object), text=value))
        elif isinstance(value, list) and value and all(isinstance(v, int | float) for v in value):
            lists[str(name)] = np.array(value, np.float64)
            variables.append(Variable(str(name), (len(value),), np.dtype(np.float64)))
    found = choose_wavelengths(variables, Variable("", (), np.dtype(float)))
    return None if found is None else (lists[found.name], found.units)


def _in_gdal(text: str) -> tuple[Floats, str | None] | None:
    """Items ``wavelength`` of the bands (``sample``), or one of that name with them all; else GDAL's own, in um."""
    stated: dict[str, dict[str, str]] = {}
    for attributes, value in _ITEM.findall(text):
        named = dict(_ATTRIBUTE.findall(attributes))
        stated.setdefault(named.get("name", "").lower(), {})[named.get("sample", "")] = html.unescape(value).strip()
    units = set(stated.get("wavelength_units", stated.get("wavelength_unit", {})).values())
    unit = " or ".join(sorted(units)) or None
    for name, its_unit in (("wavelength", unit), ("wavelengths", unit), ("central_wavelength_um", "um")):
        bands = stated.get(name, {})
        if "" in bands:
            return _numbers(re.split(r"[\s,{}]+", bands[""]), its_unit)
        if bands and set(bands) == {str(i) for i in range(len(bands))}:
            return _numbers([bands[str(i)] for i in range(len(bands))], its_unit)
    return None


def _in_description(text: str) -> tuple[Floats, str | None] | None:
    """OME's channels, a JSON object, or ``wavelength = {...}`` as in an ENVI header."""
    if "<OME" in text or ":OME" in text:
        channels = [dict(_ATTRIBUTE.findall(attributes)) for attributes in _CHANNEL.findall(text)]
        units = {c.get("EmissionWavelengthUnit", "nm") for c in channels}
        if channels and all("EmissionWavelength" in c for c in channels) and len(units) == 1:
            return _numbers([c["EmissionWavelength"] for c in channels], units.pop())
        return None
    if text.lstrip().startswith("{"):
        try:
            described = json.loads(text)
        except (ValueError, RecursionError):
            return None
        return _in_mapping(described) if isinstance(described, dict) else None
    found = re.search(r"\bwavelengths?\s*[=:]\s*[{\[(]([^}\])]*)[}\])]", text, re.IGNORECASE)
    stated = re.search(r"\bwavelength[ _]units?\s*[=:]\s*([^\s;,]+)", text, re.IGNORECASE)
    return None if found is None else _numbers(re.split(r"[\s,;]+", found[1]), stated[1] if stated else None)


def _numbers(words: Sequence[str], unit: str | None) -> tuple[Floats, str | None] | None:
    """Numbers, each of which may carry its unit; None where one is none."""
    found = [_NUMBER.fullmatch(word) for word in words if word]
    if not found or not all(found):
        return None
    try:
        values = [float(match[1]) for match in found if match]
    except ValueError:
        return None
    own = {match[2] for match in found if match and match[2]}
    return np.array(values, np.float64), unit or (own.pop() if len(own) == 1 else None)

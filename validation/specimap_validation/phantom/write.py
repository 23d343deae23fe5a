"""A phantom's folder: ``rgb/view_000.jpg`` ..., ``hsi/hsi.hdr`` with ``hsi/hsi.raw``, ``truth.npz``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.atomic import atomic_path, write_text
from specimap_core.errors import SettingsError
from specimap_core.truth.truth_file import Truth, save_truth
from specimap_validation.phantom.phantom import REFLECTANCE_SCALE, Phantom
from specimap_validation.phantom.settings import PhantomSettings

_AXES = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}
_PHOTOS_SHARE, _CUBE_SHARE = 0.75, 0.95
_ENCODERS = {"jpg": cv2.IMWRITE_JPEG_QUALITY, "png": None}


def write_phantom(
    of: PhantomSettings | Phantom,
    folder: Path,
    *,
    interleave: str = "bsq",
    photo_format: str = "jpg",
    progress: Callable[[float], None] = lambda share: None,
) -> Truth:
    """Write a phantom, or the quick one of some settings, into ``folder`` and return its truth.

    ``interleave``: bsq, bil or bip. ``photo_format``: jpg or png. Raises ``SettingsError``; what ``progress`` raises
    ends the writing.
    """
    if interleave not in _AXES:
        raise SettingsError(f"interleave is {interleave}.", advice="Use bsq, bil or bip.", setting="interleave")
    if photo_format not in _ENCODERS:
        raise SettingsError(f"photo_format is {photo_format}.", advice="Use jpg or png.", setting="photo_format")
    phantom = of if isinstance(of, Phantom) else Phantom(of)
    settings = phantom.settings
    flag = _ENCODERS[photo_format]
    names = []
    with closing(phantom.photos()) as photos:
        for name, image in photos:
            names.append(f"rgb/{name}.{photo_format}")
            options = [flag, phantom.jpeg_quality(len(names) - 1)] if flag is not None else []
            _, encoded = cv2.imencode(f".{photo_format}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
            with atomic_path(folder / names[-1]) as aside:
                aside.write_bytes(encoded.tobytes())
            progress(_PHOTOS_SHARE * len(names) / settings.photos)
    write_cube(phantom.cube(), settings.wavelengths_nm, folder / "hsi" / "hsi.hdr", interleave=interleave)
    progress(_CUBE_SHARE)
    truth = replace(phantom.truth, photo_names=names)
    save_truth(truth, folder / "truth.npz")
    progress(1.0)
    return truth


def write_cube(cube: NDArray[np.uint16], wavelengths_nm: Floats, header: Path, *, interleave: str) -> None:
    """Write a cube (rows, columns, bands) of scaled reflectance: ENVI ``header``, and ``.raw`` in the same folder."""
    rows, cols, bands = cube.shape
    with atomic_path(header.with_suffix(".raw")) as aside:
        np.ascontiguousarray(cube.transpose(_AXES[interleave]), "<u2").tofile(aside)
    wavelengths = ",\n".join(f" {w:.3f}" for w in wavelengths_nm)
    write_text(
        header,
        f"""ENVI
description = {{ synthetic specimen, reflectance x {REFLECTANCE_SCALE} }}
samples = {cols}
lines = {rows}
bands = {bands}
header offset = 0
file type = ENVI Standard
data type = 12
interleave = {interleave}
byte order = 0
reflectance scale factor = {REFLECTANCE_SCALE}
sensor type = synthetic
wavelength units = nm
wavelength = {{
{wavelengths}}}
""",
    )

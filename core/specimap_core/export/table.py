"""CSV: one line a point, one column a wavelength."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from specimap_core.atomic import atomic_path
from specimap_core.cloud import Cloud
from specimap_core.cloud.encoding import LARGEST

_BLOCK = 2048
_COLUMNS = (
    "x_mm",
    "y_mm",
    "z_mm",
    "normal_x",
    "normal_y",
    "normal_z",
    "red",
    "green",
    "blue",
    "sigma_mm",
    "flags",
    "hsi_row",
    "hsi_col",
)
_LINE = "%.4f,%.4f,%.4f,%.4f,%.4f,%.4f,%d,%d,%d,%.4f,%d,%d,%d"


def write_csv(cloud: Cloud, target: Path) -> Path:
    """Write a header and one line for each point; spectra are decoded (reflectance, or counts).

    What has no value is ``nan``. A spectral column is headed by its wavelength in nm, or by ``band_<index>`` where that
    is unknown.
    """
    known = np.isfinite(cloud.wavelengths_nm).all() and len(set(_names(cloud))) == cloud.bands
    bands = _names(cloud) if known else [f"band_{i}" for i in range(cloud.bands)]
    texts = _texts(cloud)
    with atomic_path(target) as aside, open(aside, "wb") as file:
        file.write((",".join([*_COLUMNS, *bands]) + "\n").encode("ascii"))
        for part, spectra in cloud.iter_chunks(_BLOCK):
            geometry = np.array([_LINE % values for values in _rows(cloud, part)], "S")
            width = geometry.itemsize
            line = np.empty((len(spectra), width + cloud.bands * texts.itemsize + 1), np.uint8)
            line[:, :width] = geometry.view(np.uint8).reshape(-1, width)
            line[:, width:-1] = texts[spectra].view(np.uint8).reshape(len(spectra), -1)
            line[:, -1] = ord("\n")
            # The cells are padded with NUL to a common width; this takes the padding out.
            file.write(line.tobytes().translate(None, b"\0"))
    return target


def _names(cloud: Cloud) -> list[str]:
    return [f"{wavelength:.2f}" for wavelength in cloud.wavelengths_nm.tolist()]


def _texts(cloud: Cloud) -> NDArray[np.bytes_]:
    """What each stored value reads as, with the comma before it: formatting 65536 values once is enough."""
    stored = np.arange(LARGEST + 1)
    values = (stored * cloud.scale_factor + cloud.add_offset).tolist()
    form = ".4f" if cloud.quantity == "reflectance" else ".9g"
    texts = [f",{value:{form}}" for value in values]
    if cloud.fill_value is not None:
        texts[cloud.fill_value] = ",nan"
    return np.array(texts, "S")


def _rows(cloud: Cloud, part: slice) -> zip[tuple[float, ...]]:
    columns = [
        *cloud.xyz[part].T,
        *cloud.normal[part].T,
        *cloud.rgb[part].T,
        cloud.sigma_mm[part],
        cloud.flags[part],
        *cloud.hsi_pixel[part].T,
    ]
    return zip(*(column.tolist() for column in columns), strict=True)

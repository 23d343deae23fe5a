"""NPZ: everything, for numpy, MATLAB's and R's readers; uncompressed, so that it loads fast."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from specimap_core.arrays import Array
from specimap_core.atomic import atomic_path
from specimap_core.cloud import Cloud
from specimap_core.json_text import json_text

_BLOCK = 16384


def write_npz(cloud: Cloud, target: Path) -> Path:
    """Write all arrays under their names in the cloud, ``spectra`` as stored (S, B) uint16.

    ``scale_factor`` and ``add_offset`` decode the spectra into ``quantity``; ``fill_value``, where it is there, is
    stored where there is no value. ``attributes`` is the group's attributes as a JSON text.
    """
    small: dict[str, Array] = {
        "xyz": cloud.xyz,
        "hsi_pixel": cloud.hsi_pixel,
        "normal": cloud.normal,
        "rgb": cloud.rgb,
        "sigma_mm": cloud.sigma_mm,
        "flags": cloud.flags,
        "wavelength_nm": cloud.wavelengths_nm,
        "bad_bands": cloud.bad_bands,
        "scale_factor": np.array(cloud.scale_factor),
        "add_offset": np.array(cloud.add_offset),
        "quantity": np.array(cloud.quantity),
        "attributes": np.array(json_text(cloud.attributes)),
    }
    if cloud.fill_value is not None:
        small["fill_value"] = np.array(cloud.fill_value, np.uint16)
    with atomic_path(target) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as archive:
        for name, values in small.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)
        with archive.open("spectra.npy", "w", force_zip64=True) as member:
            shape = (cloud.n_points, cloud.bands)
            layout = {"descr": "<u2", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(member, layout)
            for _, block in cloud.iter_chunks(_BLOCK):
                member.write(np.ascontiguousarray(block, "<u2").data)
    return target

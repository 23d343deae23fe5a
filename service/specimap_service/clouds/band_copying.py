"""Writing a band-major copy of a cloud's spectra, in a drawing process. It loads no web framework."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from specimap_core.atomic import atomic_path
from specimap_infra.settings import ServiceSettings
from specimap_service.clouds.drawing import opened, settle

POINTS_TOGETHER = 65536
"""Spectra that are turned around together: 38 MB of a full-size cloud."""


def copy_bands(settings: ServiceSettings, prefix: str, target: Path) -> None:
    """Write the stored spectra (S, B) of the cloud in ``prefix`` to ``target`` as uint16 (B, S), without a header.

    Raises:
        CloudDamagedError, StorageUnavailableError: the cloud cannot be read. StorageFullError, OutputNotWritableError.
    """
    settle()
    cloud = opened(settings, prefix).cloud
    shape = cloud.bands, cloud.n_points
    with atomic_path(target) as aside:
        with aside.open("xb") as file:
            # A mapped file with holes would end the process by a signal on a full disk.
            os.posix_fallocate(file.fileno(), 0, 2 * shape[0] * shape[1])
        copy = np.memmap(aside, np.uint16, "r+", shape=shape)
        for part, spectra in cloud.iter_chunks(POINTS_TOGETHER):
            copy[:, part] = spectra.T
        copy.flush()

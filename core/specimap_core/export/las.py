"""LAS 1.4, point format 7: for point cloud programs that know no units but their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap_core import __version__
from specimap_core.atomic import atomic_path
from specimap_core.cloud import SHARD_POINTS, Cloud
from specimap_core.errors import BackendUnavailableError

# A micrometre: far below any error of position, and 32 bits then span 4 m.
_SCALE_MM = 0.001
# LAS holds colours in 16 bits; 255 becomes 65535.
_COLOUR = 257


def write_las(cloud: Cloud, target: Path) -> Path:
    """Write the points in the cloud's order; coordinates are mm in the marker frame. Spectra stay in the cloud.

    Extra dimensions: ``sigma_mm``, ``flags``, ``hsi_row``, ``hsi_col``. Raises BackendUnavailableError
    where laspy is not installed.
    """
    try:
        import laspy
    except ImportError as error:
        raise BackendUnavailableError(
            "The LAS export needs laspy, which is not installed.", advice="Install specimap[pipeline]."
        ) from error
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales = np.full(3, _SCALE_MM)
    header.offsets = np.round((cloud.chunk_aabb[:, :3].min(0) + cloud.chunk_aabb[:, 3:].max(0)) / 2.0)
    header.generating_software = f"Specimap {__version__}"
    header.system_identifier = "mm, marker frame"
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("sigma_mm", np.float32, "std of position, mm"),
            laspy.ExtraBytesParams("flags", np.uint8, "Specimap flag bits"),
            laspy.ExtraBytesParams("hsi_row", np.uint16, "row in the cube"),
            laspy.ExtraBytesParams("hsi_col", np.uint16, "column in the cube"),
        ]
    )
    with (
        atomic_path(target) as aside,
        open(aside, "wb") as file,
        laspy.open(file, mode="w", header=header, do_compress=False, closefd=False) as writer,
    ):
        for start in range(0, cloud.n_points, SHARD_POINTS):
            part = slice(start, start + SHARD_POINTS)
            record = laspy.ScaleAwarePointRecord.zeros(len(cloud.flags[part]), header=header)
            record.x, record.y, record.z = cloud.xyz[part].T.astype(np.float64)
            record.red, record.green, record.blue = cloud.rgb[part].T.astype(np.uint16) * _COLOUR
            record.return_number[:] = 1
            record.number_of_returns[:] = 1
            record["sigma_mm"] = cloud.sigma_mm[part]
            record["flags"] = cloud.flags[part]
            record["hsi_row"], record["hsi_col"] = cloud.hsi_pixel[part].T
            writer.write_points(record)
    return target

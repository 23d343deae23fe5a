"""The spectral cloud: points in the marker frame, each with a full spectrum, as a Zarr v3 group.

Reading needs numpy and zarr only. :func:`~specimap_core.cloud.writer.write_cloud` is imported from its
module, since it needs tensorstore, which a service that only reads does without.
"""

from specimap_core.cloud.reader import Cloud
from specimap_core.cloud.schema import (
    ARRAYS,
    CHUNK_POINTS,
    SHARD_POINTS,
    TILE,
    CloudPoints,
    Flag,
    SpectraSource,
    chunk_bounds,
    tile_order,
)

__all__ = [
    "ARRAYS",
    "CHUNK_POINTS",
    "SHARD_POINTS",
    "TILE",
    "Cloud",
    "CloudPoints",
    "Flag",
    "SpectraSource",
    "chunk_bounds",
    "tile_order",
]

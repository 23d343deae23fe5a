"""What the service is measured on: a cube to upload, and a finished cloud of usual size."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.sample import SAMPLE
from bench.service.serving import Served
from bench.synthetic import BANDS, COLS, ROWS, enlarge, write_envi_cube
from specimap_core.cloud import Cloud, CloudPoints
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import open_cube
from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, CloudRow, Job

CUBE_ROWS = 400
POINTS_ACROSS = 750
"""Columns of the cube's middle that have points: 300,000 with its 400 rows."""
FULL_ACROSS = 1172
"""With the 1024 rows of a full-size cube, 1.2 million points."""
MM_PER_PIXEL = 0.1


def cube_file(work: Path) -> Path:
    """Header of a cube of 297 MB (1280 x 400 x 290, uint16, BIL); made once."""
    header = work / "cube.hdr"
    if not header.exists():
        write_envi_cube(enlarge(SAMPLE / "hsi" / "hsi.hdr", CUBE_ROWS, COLS, BANDS), header, "uint16", "bil")
        os.sync()  # its pages must not be on their way to the disk while something else is measured
    return header


def large_cube_file(work: Path) -> Path:
    """Header of a cube of 1.52 GB (1280 x 1024 x 290, float32, BIL); made once."""
    header = work / "large.hdr"
    if not header.exists():
        write_envi_cube(enlarge(SAMPLE / "hsi" / "hsi.hdr", ROWS, COLS, BANDS), header, "float32", "bil")
        os.sync()
    return header


@dataclass(frozen=True)
class Result:
    """A finished cloud that a service knows, and its Zarr group in the service's storage."""

    cloud_id: str
    group: Path

    @property
    def cloud(self) -> Cloud:
        """Opened from the folder."""
        return Cloud.open(self.group)

    @property
    def path(self) -> str:
        """Of its resources."""
        return f"/v1/clouds/{self.cloud_id}"


def full_cube_file(work: Path) -> Path:
    """Header of a cube of 760 MB (1280 x 1024 x 290, uint16, BIL); made once."""
    header = work / "full.hdr"
    if not header.exists():
        write_envi_cube(enlarge(SAMPLE / "hsi" / "hsi.hdr", ROWS, COLS, BANDS), header, "uint16", "bil")
        os.sync()
    return header


def put_full_result(served: Served, work: Path) -> Result:
    """Give a running service a cloud of a full-size cube: 1.2 million points and 290 bands."""
    return put_result(served, work, full_cube_file(work), (ROWS, FULL_ACROSS))


def put_result(
    served: Served, work: Path, header: Path | None = None, size: tuple[int, int] = (CUBE_ROWS, POINTS_ACROSS)
) -> Result:
    """Give a running service a cloud of 290 bands, as a worker leaves it; by default 300,000 points.

    ``size``: rows of ``header``'s cube that have points, and how many of its columns.
    """
    job_id, cloud_id, acquisition_id = new_id("job"), new_id("cloud"), new_id("acq")
    storage, prefix = Storage.open(served.settings), f"jobs/{job_id}/register/{new_id('att')}"
    with storage.publishing(prefix) as folder:
        write_cloud(folder / "cloud.zarr", _points(*size), open_cube(header or cube_file(work)), {})
    group = storage.path(f"{prefix}/cloud.zarr")
    assert group is not None
    cloud, now = Cloud.open(group), utc_now()
    database = Database.open(served.settings.database)
    with database.session() as session:
        session.add(
            Acquisition(
                project_id=DEFAULT_PROJECT,
                id=acquisition_id,
                specimen_id="bench",
                dictionary="DICT_4X4_50",
                edge_mm=6.8,
                notes="",
                created_by="key_bench",
            )
        )
        session.flush()
        session.add(
            Job(
                id=job_id,
                acquisition_id=acquisition_id,
                settings={},
                priority=5,
                state="succeeded",
                starts=1,
                request_hash="",
                correlation_id="bench",
                seconds={},
                started_at=now,
                finished_at=now,
                created_by="key_bench",
            )
        )
        session.flush()
        session.add(
            CloudRow(
                id=cloud_id,
                job_id=job_id,
                acquisition_id=acquisition_id,
                prefix=prefix,
                points=cloud.n_points,
                bands=cloud.bands,
                size=folder_bytes(group),
                report={},
            )
        )
    database.close()
    os.sync()
    return Result(cloud_id, group)


def folder_bytes(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _points(rows: int, across: int) -> CloudPoints:
    """Points of the middle of the cube on a wavy surface."""
    row, col = np.divmod(np.arange(rows * across), across)
    n = len(row)
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(n, 3)).astype(np.float32)
    return CloudPoints(
        hsi_pixel=np.stack([row, col + (COLS - across) // 2], 1).astype(np.uint16),
        xyz=np.stack([MM_PER_PIXEL * col, -MM_PER_PIXEL * row, np.sin(row / 90) * np.cos(col / 70)], 1).astype(
            np.float32
        ),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        rgb=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        sigma_mm=rng.random(n).astype(np.float32),
        flags=np.ones(n, np.uint8),
    )

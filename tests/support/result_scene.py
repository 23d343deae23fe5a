"""A finished result in a running service: rows and files as a worker leaves them, with values that tests know."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import sqlalchemy as sa

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud, CloudPoints
from specimap_core.cloud.labels import write_label
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.writer import write_cloud
from specimap_core.register.figures import MethodFigures, Quartiles, Spread
from specimap_core.report.cameras import Cameras
from specimap_core.report.model import (
    Coverage,
    CubeCameraFigures,
    EdgeLength,
    Inliers,
    Parallax,
    Photos,
    Report,
    Reprojection,
    SigmaFigures,
)
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.mesh_files import write_mesh_ply
from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.tables import Acquisition, CloudRow, Job, LabelVersion
from specimap_service.contract.examples import recorded
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.service_scene import Running


@dataclass
class Result:
    """A result that the service knows. ``local``: the same files in a folder of the test."""

    cloud_id: str
    job_id: str
    acquisition_id: str
    prefix: str
    local: Path
    cube: FakeCube

    @property
    def cloud(self) -> Cloud:
        """The test's own copy of the cloud, opened anew."""
        return Cloud.open(self.local / "cloud.zarr")


def put_result(
    running: Running,
    local: Path,
    *,
    cube: FakeCube | None = None,
    points: CloudPoints | None = None,
    specimen_id: str = "specimen-1",
    accession_number: str | None = None,
    state: str = "succeeded",
    acquisition_id: str | None = None,
) -> Result:
    """Write a small result into ``local`` (a new folder), store it, and add its rows.

    By default the cloud of 70 x 53 pixels and 7 bands of ``cloud_scene``; ``acquisition_id`` adds a further job and
    cloud to an acquisition that is there.
    """
    cube = FakeCube(counts(), bad=(2,)) if cube is None else cube
    points = scene(cube.rows, cube.cols) if points is None else points
    local.mkdir(parents=True)
    report = report_of(len(points))
    write_cloud(local / "cloud.zarr", points, cube, {"report": report.model_dump(mode="json")})
    cloud = Cloud.open(local / "cloud.zarr")
    write_mesh_ply(local / "mesh.ply", mesh_of(cloud))
    (local / "report.json").write_text(report.model_dump_json(indent=1), encoding="utf-8")
    corners = {
        str(i): [[10.0 * i, 0, 0], [10.0 * i + 6.8, 0, 0], [10.0 * i + 6.8, -6.8, 0], [10.0 * i, -6.8, 0]]
        for i in range(4)
    }
    (local / "corners.json").write_text(json.dumps(corners), encoding="utf-8")
    cameras = recorded()["schemas"]["Cameras"]
    (local / "cameras.json").write_text(Cameras.model_validate(cameras).text(), encoding="utf-8")
    write_preview(cloud, local / "preview.png")

    job, cloud_id, new_acquisition = new_id("job"), new_id("cloud"), acquisition_id is None
    acquisition = acquisition_id or new_id("acq")
    prefix = f"jobs/{job}/register/{new_id('att')}"
    with running.storage.publishing(prefix) as folder:
        for file in (path for path in local.rglob("*") if path.is_file()):
            target = folder / file.relative_to(local)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    size = sum(path.stat().st_size for path in local.rglob("*") if path.is_file())
    with running.database.session() as session:
        if new_acquisition:
            session.add(
                Acquisition(
                    project_id=DEFAULT_PROJECT,
                    id=acquisition,
                    specimen_id=specimen_id,
                    accession_number=accession_number,
                    dictionary="DICT_4X4_50",
                    edge_mm=6.8,
                    notes="",
                    created_by="key_test",
                )
            )
            session.flush()
        session.add(
            Job(
                id=job,
                acquisition_id=acquisition,
                settings={},
                priority=5,
                state=state,
                stage=None,
                progress=1.0,
                starts=1,
                request_hash="0" * 64,
                correlation_id="test",
                seconds={"register": 1.5},
                started_at=utc_now(),
                finished_at=utc_now(),
                created_by="key_test",
            )
        )
        session.flush()
        session.add(
            CloudRow(
                id=cloud_id,
                job_id=job,
                acquisition_id=acquisition,
                prefix=prefix,
                points=cloud.n_points,
                bands=cloud.bands,
                size=size,
                report=report.model_dump(mode="json"),
            )
        )
    return Result(cloud_id, job, acquisition, prefix, local, cube)


def put_label(running: Running, result: Result, name: str, values: Array) -> None:
    """Add a version of a label layer: whole numbers (S,) are classes, floats (S,) or (S, C) probabilities."""
    prefix = f"clouds/{result.cloud_id}/labels/{name}/{new_id('att')}"
    with running.storage.publishing(prefix) as folder:
        write_label(folder, values)
    layer = sa.select(sa.func.max(LabelVersion.version)).where(
        LabelVersion.cloud_id == result.cloud_id, LabelVersion.name == name
    )
    with running.database.session() as session:
        session.add(
            LabelVersion(
                cloud_id=result.cloud_id,
                name=name,
                version=(session.scalar(layer) or 0) + 1,
                kind="class" if values.dtype.kind in "iu" else "probability",
                classes=[],
                made_by={"name": "test"},
                storage_prefix=prefix,
                sha256="0" * 64,
                created_by="key_test",
            )
        )
    running.app.state.open_clouds.forget(result.cloud_id)


def mesh_of(cloud: Cloud) -> Mesh:
    """A surface of a few hundred triangles under the cloud's points."""
    x = np.linspace(cloud.xyz[:, 0].min(), cloud.xyz[:, 0].max(), 20)
    y = np.linspace(cloud.xyz[:, 1].min(), cloud.xyz[:, 1].max(), 15)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    vertices = np.concatenate([grid, np.sin(grid[:, :1])], 1)
    at = (np.arange(14)[:, None] * 20 + np.arange(19)).ravel()
    triangles = np.concatenate([np.stack([at, at + 1, at + 20], 1), np.stack([at + 1, at + 21, at + 20], 1)])
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    colours = np.full((len(vertices), 3), (180, 90, 90), np.uint8)
    return Mesh(vertices.astype(np.float32), triangles.astype(np.int32), normals.astype(np.float32), colours)


def report_of(points: int) -> Report:
    """A whole report; only its shape matters."""
    spread, quartiles = Spread(mean=0.1, std=0.05, n=16), Quartiles(median=0.1, q1=0.05, q3=0.15, n=16)
    return Report(
        specimap_version="0",
        created="2026-01-01T00:00:00Z",
        method="camera",
        backend="colmap",
        adjustment="joint",
        marker_ids=[0, 1, 2, 3],
        marker_ids_in_cube=[0, 1, 2, 3],
        corner_2d_mm=spread,
        corner_3d_mm=quartiles,
        leave_one_marker_out_mm=None,
        methods={"camera": MethodFigures(corner_2d_mm=spread, corner_3d_mm=quartiles, leave_one_marker_out_mm=None)},
        edge_length_mm=EdgeLength(expected=6.8, mean=6.8, std=0.01, n=16),
        corner_sigma_mm=0.01,
        reprojection_px=Reprojection(before=0.5, after=0.2),
        photos=Photos(given=3, used=["photo-0001.jpg", "photo-0002.jpg", "photo-0003.jpg"], refused=[]),
        inliers=Inliers(n=16, of=16, threshold_px=3, threshold_mm=6),
        coverage=Coverage(between_markers=0.98, points=points, specimen_points=points // 2),
        parallax_removed_mm=Parallax(median=0.4, maximum=2.0),
        sigma_mm=SigmaFigures(median=0.1, p95=0.3),
        cube_camera=CubeCameraFigures(
            focal_px=1200,
            focal_relative_sd=0.01,
            distance_mm=300,
            reprojection_rms_px=0.2,
            roll_deg=1,
            mirrored=False,
            markers_found_in="mean",
        ),
        photo_focal_px=1500,
        seconds={"register": 1.5},
        reused_stages=[],
        warnings=[],
    )

"""A project's objects, one of each kind, and a request for each operation of the API on them."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import SCOPES, StoredFile
from specimap_service.auth.keys import new_key
from specimap_service.auth.shares import new_share
from tests.support.job_scene import acquisition, queued_job
from tests.support.label_files import header, layer, npy
from tests.support.result_scene import put_result
from tests.support.service_scene import Running
from tests.support.upload_scene import OCTETS, TUS, created, metadata

JUDGEMENT: dict[str, Any] = {
    "kind": "photo",
    "verdict": "accepted",
    "code": None,
    "reason": "",
    "advice": "",
    "width": 4,
    "height": 3,
    "sharpness": 0.5,
    "marker_ids": [],
    "dictionary_seen": None,
    "same_as": None,
}
KINDS = {
    "project_id": "prj",
    "key_id": "key",
    "acquisition_id": "acq",
    "file_id": "file",
    "upload_id": "up",
    "job_id": "job",
    "cloud_id": "cloud",
    "share_id": "shr",
}
"""Kinds of ids by their names in addresses."""
OTHERS = {"key": "zarr.json", "format": "mesh-ply", "index": "0", "band": "0"}
"""What else stands in addresses, as an example."""


@dataclass
class World:
    """One object of each kind, of one project. ``spare``: others, for what is not possible with those in use."""

    ids: dict[str, str]
    spare: dict[str, str]
    name: str
    points: int

    def strings(self) -> set[str]:
        """All ids."""
        return {*self.ids.values(), *self.spare.values()}

    def absent(self) -> World:
        """The same with ids that do not exist; the layer's name stays, since names are no secret of a project's."""
        gone = {name: f"{KINDS[name]}_{'0' * 25}z" for name in self.ids}
        return World(gone, gone, self.name, self.points)


def make_world(service: Running, folder: Path, project: str, uploader: httpx.Client) -> World:
    """Fill a project. ``uploader`` has one of its keys, and begins the upload: no other key may continue it."""
    database = service.database
    owner, spare = acquisition(database, project=project), acquisition(database, project=project)
    result = put_result(service, folder, acquisition_id=owner)
    points = result.cloud.n_points
    labelled = service.client(["label"], project=project).put(
        layer(result), content=npy(np.zeros(points, np.uint8)), headers=header()
    )
    assert labelled.status_code == 201, labelled.text
    with database.session() as session:
        files = {}
        for stored in session.scalars(sa.select(StoredFile).where(StoredFile.acquisition_id.in_([owner, spare]))):
            stored.judgement = JUDGEMENT
            if stored.role == "photo":
                files[stored.acquisition_id] = stored.id
            service.storage.put(stored.storage_key, b"x")
        row, _ = new_key("of the world", ["read"], project_id=project)
        session.add(row)
        key = row.id
        share, _ = new_share(
            result.cloud_id, "board", utc_now() + datetime.timedelta(days=1), created_by=key, secret=None
        )
        session.add(share)
        share_id = share.id
    if service.settings.study_keys:
        given = uploader.put(f"/v1/acquisitions/{owner}/study", json={"patient_id": "1"})
        assert given.status_code == 200, given.text
    if service.settings.fhir_url:
        assert uploader.post(f"/v1/clouds/{result.cloud_id}/fhir").status_code == 202
    upload = created(uploader, owner, "photo", 3).rpartition("/")[2]
    return World(
        {
            "project_id": project,
            "key_id": key,
            "acquisition_id": owner,
            "file_id": files[owner],
            "upload_id": upload,
            "job_id": result.job_id,
            "cloud_id": result.cloud_id,
            "share_id": share_id,
        },
        {"acquisition_id": spare, "file_id": files[spare], "job_id": queued_job(database, spare)},
        "tissue",
        points,
    )


# ---- requests -----------------------------------------------------------------------------------------

Given = Callable[[World], dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """A request that succeeds for a key with the scope in the objects' project.

    ``scope``: None where every key will do. ``given``: arguments of the request. ``aims``: whether it names an object.
    ``spare``: on the spare objects. ``ends``: it deletes something, so it comes last. ``also``: scopes that the key
    needs besides.
    """

    scope: str | None
    status: int = 200
    given: Given = field(default=lambda _: {})
    aims: bool = False
    spare: bool = False
    also: tuple[str, ...] = ()

    def path(self, path: str, world: World) -> str:
        """The address of the world's object."""
        ids = {**world.ids, **(world.spare if self.spare else {})}
        return path.format(**OTHERS, **ids, uuid=ids["upload_id"], name=world.name)

    def send(self, client: httpx.Client, method: str, path: str, world: World) -> httpx.Response:
        """Make the request."""
        return client.request(method, self.path(path, world), **self.given(world))


def _tus(**headers: str) -> Given:
    return lambda _: {"headers": {**TUS, **headers}}


def _json(**body: Any) -> Given:
    return lambda _: {"json": body}


def _upload(world: World) -> dict[str, Any]:
    fields = metadata(acquisition=world.ids["acquisition_id"], role="photo", filename="x")
    return {"headers": {**TUS, "Upload-Length": "3", "Upload-Metadata": fields}}


def _names(_: World) -> dict[str, Any]:
    return {"json": {"name": new_id("att")}}


def _share(_: World) -> dict[str, Any]:
    return {"json": {"name": "board", "expires_at": (utc_now() + datetime.timedelta(days=30)).isoformat()}}


CLOUD = "/v1/clouds/{cloud_id}"
PREVIEWS, LABEL, EXPORT = f"{CLOUD}/previews", f"{CLOUD}/labels/{{name}}", f"{CLOUD}/exports/{{format}}"
ACQUISITION, JOB, FILE = "/v1/acquisitions/{acquisition_id}", "/v1/jobs/{job_id}", "/files/{file_id}"


def _read(given: Given = lambda _: {}, status: int = 200) -> Case:
    return Case("read", status, given, aims=True)


def _params(**params: str) -> Given:
    return lambda _: {"params": params}


CASES: dict[tuple[str, str], Case] = {
    ("GET", "/metrics"): Case("admin"),
    ("GET", "/v1/audit"): Case("audit"),
    ("GET", "/v1/keys"): Case("admin"),
    ("POST", "/v1/keys"): Case("admin", 201, _json(name="x", scopes=["read"])),
    ("GET", "/v1/session"): Case(None),
    ("DELETE", "/v1/session"): Case(None, 204),
    ("POST", "/v1/sso/logout"): Case(None),
    ("GET", "/v1/projects"): Case("read"),
    ("POST", "/v1/projects"): Case("admin", 201, _names),
    ("GET", "/v1/projects/{project_id}"): _read(),
    ("PATCH", "/v1/projects/{project_id}"): Case("admin", 200, _names, aims=True),
    # acquisitions, files, uploads
    ("GET", "/v1/acquisitions"): Case("read"),
    ("POST", "/v1/acquisitions"): Case("upload", 201, _json(specimen_id="S-2")),
    ("GET", ACQUISITION): _read(),
    ("GET", f"{ACQUISITION}/files"): _read(),
    ("GET", f"{ACQUISITION}/viewpoints"): _read(),
    ("POST", f"{ACQUISITION}/files"): Case(
        "upload", 201, lambda _: {"data": {"role": "photo"}, "files": {"file": ("x", b"x")}}, aims=True
    ),
    ("GET", f"{ACQUISITION}{FILE}"): _read(),
    ("GET", f"{ACQUISITION}{FILE}/content"): _read(),
    ("OPTIONS", "/v1/uploads"): Case("upload", 204),
    ("POST", "/v1/uploads"): Case("upload", 201, _upload, aims=True),
    ("HEAD", "/v1/uploads/{uuid}"): Case("upload", 200, _tus(), aims=True),
    ("PATCH", "/v1/uploads/{uuid}"): Case(
        "upload",
        204,
        lambda _: {"content": b"x", "headers": {**TUS, "Upload-Offset": "0", "Content-Type": OCTETS}},
        aims=True,
    ),
    ("GET", "/v1/uploads/{upload_id}/result"): Case("upload", aims=True),
    ("PUT", f"{ACQUISITION}/hold"): Case("admin", 201, _json(reason="lawsuit-7"), aims=True),
    ("GET", f"{ACQUISITION}/hold"): Case("admin", aims=True),
    ("DELETE", f"{ACQUISITION}/hold"): Case("admin", 204, aims=True),
    # Every world has the same specimen: allowed, but there is none of this name.
    ("POST", "/v1/erasures"): Case("admin", 404, _json(specimen_id="S-nowhere")),
    ("GET", "/v1/erasures"): Case("admin"),
    # jobs
    ("GET", "/v1/jobs"): Case("read"),
    ("POST", "/v1/jobs"): Case(
        "upload", 202, lambda w: {"json": {"acquisition_id": w.ids["acquisition_id"]}}, aims=True
    ),
    ("GET", JOB): _read(),
    ("GET", f"{JOB}/report"): _read(),
    ("GET", f"{JOB}/log"): _read(),
    ("GET", f"{JOB}/events"): _read(status=204),
    ("GET", f"{JOB}/deliveries"): _read(),
    # A job without a webhook: allowed, but there is nothing to send.
    ("POST", f"{JOB}/deliveries"): Case("upload", 409, aims=True),
    ("POST", f"{JOB}/rerun"): Case("upload", 202, aims=True),
    # clouds
    ("GET", "/v1/clouds"): Case("read"),
    ("GET", CLOUD): _read(),
    ("GET", f"{CLOUD}/corners"): _read(),
    ("GET", f"{CLOUD}/cameras"): _read(),
    ("GET", f"{CLOUD}/zarr/{{key}}"): _read(),
    ("HEAD", f"{CLOUD}/zarr/{{key}}"): _read(),
    ("GET", f"{CLOUD}/points/{{index}}"): _read(),
    ("GET", f"{CLOUD}/bands/{{band}}"): _read(),
    ("POST", f"{CLOUD}/spectra"): _read(_json(select={"indices": [0]})),
    ("GET", f"{PREVIEWS}/rgb.png"): _read(),
    ("GET", f"{PREVIEWS}/pca.png"): _read(),
    ("GET", f"{PREVIEWS}/band.png"): _read(_params(b="0")),
    ("GET", f"{PREVIEWS}/composite.png"): _read(_params(r="0", g="1", b="3")),
    ("GET", f"{PREVIEWS}/index.png"): _read(_params(a="0", b="1")),
    ("GET", f"{PREVIEWS}/label.png"): _read(_params(name="tissue")),
    ("GET", f"{CLOUD}/labels"): _read(),
    ("GET", LABEL): _read(),
    ("GET", f"{LABEL}/versions"): _read(),
    ("GET", f"{LABEL}/values"): _read(),
    ("PUT", LABEL): Case(
        "label", 201, lambda w: {"content": npy(np.ones(w.points, np.uint8)), "headers": header()}, aims=True
    ),
    ("POST", EXPORT): _read(),
    ("GET", EXPORT): _read(),
    ("GET", f"{CLOUD}/exports"): _read(),
    ("GET", f"{EXPORT}/content"): _read(),
    ("HEAD", f"{EXPORT}/content"): _read(),
    ("GET", f"{CLOUD}/shares"): Case("upload", aims=True),
    ("POST", f"{CLOUD}/shares"): Case("upload", 201, _share, aims=True, also=("read",)),
    # the hospital's side, where no worklist is set
    ("PUT", f"{ACQUISITION}/study"): Case("upload", 200, _json(patient_id="1"), aims=True),
    ("GET", f"{ACQUISITION}/study"): Case("upload", aims=True),
    ("POST", "/v1/orders/search"): Case("upload", 409, _json(accession_number="1")),
    ("GET", f"{CLOUD}/dicom"): _read(),
    ("GET", f"{CLOUD}/dicom.zip"): Case("upload", aims=True),
    ("POST", f"{CLOUD}/dicom"): Case("upload", 202, _json(), aims=True),
    ("POST", f"{CLOUD}/fhir"): Case("upload", 202, aims=True),
    ("GET", f"{CLOUD}/fhir"): _read(),
    # Where it is off.
    ("POST", "/v1/dicomweb/studies"): Case(None, 404),
    # what ends something: each after all that needs it
    ("DELETE", "/v1/uploads/{uuid}"): Case("upload", 204, _tus(), aims=True),
    ("DELETE", f"{CLOUD}/shares/{{share_id}}"): Case("upload", 204, aims=True),
    ("DELETE", LABEL): Case("label", 204, aims=True),
    ("DELETE", f"{ACQUISITION}/study"): Case("upload", 204, aims=True),
    ("POST", f"{JOB}/cancel"): Case("upload", 202, aims=True, spare=True),
    ("DELETE", f"{ACQUISITION}{FILE}"): Case("upload", 204, aims=True, spare=True),
    ("DELETE", JOB): Case("admin", 204, aims=True),
    ("DELETE", ACQUISITION): Case("admin", 204, aims=True, spare=True),
    ("DELETE", "/v1/keys/{key_id}"): Case("admin", 204, aims=True),
}
"""Every operation that takes a key, in the order in which they can all be made on one world."""
LESSER_SCOPES = tuple(scope for scope in SCOPES if scope != "admin")
NO_KEY = {
    ("GET", "/healthz"),
    ("GET", "/readyz"),
    ("POST", "/v1/session"),
    ("GET", "/v1/sso"),
    ("GET", "/v1/sso/login"),
    ("GET", "/v1/sso/callback"),
}
"""What needs no key: the third one takes it in its body, and people sign in with the last ones."""

"""Legal holds over the API: nothing of a held acquisition is deleted by anybody, until it is released."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import sqlalchemy as sa

from specimap_infra.tables import StoredFile
from tests.support.job_scene import acquisition
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import Running


def test_a_hold_blocks_every_deletion_and_its_release_allows_it(service: Running, tmp_path: Path) -> None:
    owner = acquisition(service.database)
    result = put_result(service, tmp_path / "result", acquisition_id=owner)
    put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.uint8))
    client, admin = service.client(["upload", "read", "label"]), service.client(["admin"])
    hold = f"/v1/acquisitions/{owner}/hold"
    assert client.put(hold, json={"reason": "lawsuit-7"}).status_code == 403
    assert client.get(hold).status_code == 403
    assert admin.get(hold).status_code == 404
    assert admin.put(hold, json={"reason": "A name, perhaps"}).status_code == 422
    made = admin.put(hold, json={"reason": "lawsuit-7"})
    assert (made.status_code, made.json()["reason"]) == (201, "lawsuit-7")
    assert admin.put(hold, json={"reason": "lawsuit-8"}).status_code == 200
    assert admin.get(hold).json()["reason"] == "lawsuit-8"
    with service.database.session() as session:
        file_id = session.scalars(sa.select(StoredFile.id).where(StoredFile.acquisition_id == owner)).first()
    deletions = {
        f"/v1/acquisitions/{owner}": admin,
        f"/v1/acquisitions/{owner}/files/{file_id}": client,
        f"/v1/jobs/{result.job_id}": admin,
        f"/v1/clouds/{result.cloud_id}/labels/tissue": client,
    }
    for path, who in deletions.items():
        refused = who.delete(path)
        assert (refused.status_code, refused.json()["code"]) == (409, "legal_hold"), path
        assert refused.json()["details"] == {"acquisition_id": owner, "reason": "lawsuit-8"}
    erased = admin.post("/v1/erasures", json={"specimen_id": "S-1"})
    assert (erased.status_code, erased.json()["code"]) == (409, "legal_hold")
    assert client.get(f"/v1/acquisitions/{owner}").status_code == 200
    assert admin.delete(hold).status_code == 204
    assert admin.delete(hold).status_code == 404
    for path, who in reversed(deletions.items()):
        assert who.delete(path).status_code == 204, path
    actions = [e["action"] for e in admin.get("/v1/audit", params={"target": owner, "limit": 500}).json()["items"]]
    assert actions == ["acquisition.delete", "hold.release", "hold.put", "hold.put"]

"""The dome of viewpoints over the API."""

from __future__ import annotations

from typing import Any

from specimap_infra.tables import StoredFile
from tests.support.service_scene import Running
from tests.support.upload_scene import new_acquisition, photos, sent


def dome(service: Running, acquisition: str) -> dict[str, Any]:
    answer = service.client(["read"]).get(f"/v1/acquisitions/{acquisition}/viewpoints")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_dome_fills_as_photos_arrive(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    empty = dome(service, acquisition)
    assert (empty["photos"], empty["unplaced"], empty["markers"], empty["covered"]) == ([], [], [], 0)
    assert empty["next"]["gap_deg"] is None
    files = [sent(client, acquisition, "photo", path.name, path.read_bytes()) for path in photos()[::4]]
    found = dome(service, acquisition)
    assert [photo["file_id"] for photo in found["photos"]] == [file["id"] for file in files]
    assert [photo["label"] for photo in found["photos"]] == [file["label"] for file in files]
    assert 25 < min(photo["elevation_deg"] for photo in found["photos"]) < 40
    assert 110 < found["photos"][0]["distance_mm"] < 145
    assert [marker["id"] for marker in found["markers"]] == [0, 1, 2, 3]
    assert 0.1 < found["covered"] < 0.5
    assert found["enough"] is False
    assert found["next"]["covered"] is False
    assert client.delete(f"/v1/acquisitions/{acquisition}/files/{files[0]['id']}").status_code == 204
    assert len(dome(service, acquisition)["photos"]) == len(files) - 1


def test_judgements_without_corners_are_photos_without_a_place(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    path = photos()[0]
    old = sent(client, acquisition, "photo", path.name, path.read_bytes())
    assert len(old["judgement"]["markers"]) == 4
    with service.database.session() as session:
        row = session.get_one(StoredFile, old["id"])
        row.judgement = {name: value for name, value in row.judgement.items() if name not in ("markers", "clipped")}
    listed = client.get(f"/v1/acquisitions/{acquisition}/files").json()
    assert (listed[0]["judgement"]["markers"], listed[0]["judgement"]["clipped"]) == ([], None)
    assert dome(service, acquisition)["unplaced"] == [{"file_id": old["id"], "label": old["label"], "markers": 0}]


def test_a_doubtful_photo_has_a_place_and_covers_nothing(service: Running) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    path = photos()[0]
    file = sent(client, acquisition, "photo", path.name, path.read_bytes())
    with service.database.session() as session:
        row = session.get_one(StoredFile, file["id"])
        row.judgement = {**row.judgement, "verdict": "doubtful", "code": "photo_blurred"}
    found = dome(service, acquisition)
    assert len(found["photos"]) == 1
    assert found["covered"] == 0


def test_no_such_acquisition(service: Running) -> None:
    answer = service.client().get(f"/v1/acquisitions/acq_{'0' * 26}/viewpoints")
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")

"""The audit trail of requests: reads and refusals are entries, like ones are counted, none is lost to an outage."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.verification import verify
from specimap_infra.database import Database
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.settings import load_settings
from specimap_infra.tables import AuditEntry
from specimap_service import audit_trail
from specimap_service.audit_trail import MOST_REFUSED, SEVERAL, Access, AuditTrail
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving

KEYS = ("acq_" + "0" * 26, "acq_" + "1" * 26)


def entries(client: httpx.Client, **given: str) -> list[dict[str, Any]]:
    """Entries, the oldest first."""
    params = {"sort": "created_at", "limit": "500", **given}
    found: list[dict[str, Any]] = client.get("/v1/audit", params=params).json()["items"]
    return found


def told(found: list[dict[str, Any]], *names: str) -> list[tuple[Any, ...]]:
    return [tuple(entry[name] for name in names) for entry in found]


def read(action: str, target: str, status: int = 200, actor: str = "key_1", address: str = "a") -> Access:
    return Access(actor, "", "p", action, target, "success" if status < 400 else "refused", status, address)


def test_reads_are_entries_with_actor_object_and_result(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    reader, admin = service.client(["read"]), service.client(["admin"])
    cloud = f"/v1/clouds/{result.cloud_id}"
    for path in (f"/v1/acquisitions/{result.acquisition_id}", cloud, f"{cloud}/zarr/zarr.json", f"{cloud}/points/3"):
        assert reader.get(path, headers={"X-Correlation-Id": "look-at-this"}).status_code == 200
    assert reader.post(f"{cloud}/spectra", json={"select": {"indices": [0]}}).status_code == 200
    found = [entry for entry in entries(admin, kind="access") if entry["action"] != "audit.list"]
    assert told(found, "action", "target", "acquisition_id", "outcome", "status") == [
        ("acquisitions.get", result.acquisition_id, result.acquisition_id, "success", 200),
        *(
            (action, result.cloud_id, result.acquisition_id, "success", 200)
            for action in ("clouds.get", "zarr.get", "spectra.get_point", "spectra.select")
        ),
    ]
    assert {entry["correlation_id"] for entry in found} >= {"look-at-this"}
    assert len({entry["key_id"] for entry in found}) == 1
    (address,) = {entry["address"] for entry in found}
    assert len(address) == 16
    assert "127.0.0.1" not in address
    # Whoever reads the trail is in it.
    entries(admin)
    assert told(entries(admin, kind="access", action="audit.list"), "action")


def test_changes_tell_address_and_acquisition_and_are_no_accesses(service: Running) -> None:
    client = service.client()
    made = client.post("/v1/acquisitions", json={"specimen_id": "S-9"}).json()["id"]
    (entry,) = entries(client, target=made)
    assert (entry["kind"], entry["outcome"], entry["acquisition_id"]) == ("change", "success", made)
    assert len(entry["address"]) == 16
    assert entries(client, target=made, kind="access") == []


def test_refusals_are_entries(service: Running) -> None:
    reader, admin = service.client(["read"]), service.client(["admin"])
    absent = f"/v1/acquisitions/{KEYS[0]}"
    assert httpx.get(f"{service.url}/v1/jobs").status_code == 401
    assert httpx.get(f"{service.url}/v1/jobs", headers={"Authorization": "Bearer spk_x_y"}).status_code == 401
    assert reader.delete(absent).status_code == 403
    assert reader.get(absent).status_code == 404
    assert reader.get("/v1/acquisitions", params={"limit": "-1"}).status_code == 422
    found = entries(admin, kind="access", outcome="refused")
    key = next(entry["key_id"] for entry in found if entry["key_id"])
    assert told(found, "key_id", "action", "target", "status") == [
        ("", "jobs.list", "", 401),
        (key, "acquisitions.delete", KEYS[0], 403),
        (key, "acquisitions.get", KEYS[0], 404),
        (key, "acquisitions.list", "", 422),
    ]
    assert found[0]["address"]


def test_filters_of_the_list(service: Running) -> None:
    client = service.client()
    made = client.post("/v1/acquisitions", json={"specimen_id": "S-9"}).json()["id"]
    client.get(f"/v1/acquisitions/{made}")
    (entry,) = entries(client, kind="access", acquisition=made)
    for given, count in (
        ({"actor": entry["key_id"]}, 2),
        ({"actor": "key_nobody"}, 0),
        ({"action": "acquisitions.get"}, 1),
        ({"action": "acquisition.create"}, 1),
        ({"created_after": "2100-01-01T00:00:00Z"}, 0),
        ({"created_before": "2100-01-01T00:00:00Z"}, 2),
        ({"outcome": "refused"}, 0),
    ):
        assert len(entries(client, kind="all", acquisition=made, **given)) == count, given


def test_thousands_of_like_reads_are_two_entries(sqlite_tables: Database, tmp_path: Path) -> None:
    trail = AuditTrail(sqlite_tables, load_settings(data_dir=tmp_path))
    now = 1000.0
    with mock.patch("specimap_service.audit_trail.time.monotonic", side_effect=lambda: now):
        for number in range(3000):
            trail.record(read("zarr.get", "cloud_1"), f"c{number}")
        trail.flush()
        assert counted(sqlite_tables) == [("zarr.get", "cloud_1", 1)]
        now += 61
        trail.flush()
        assert counted(sqlite_tables) == [("zarr.get", "cloud_1", 1), ("zarr.get", "cloud_1", 2999)]
        trail.record(read("zarr.get", "cloud_1"), "later")
        trail.record(read("zarr.get", "cloud_2"), "later")
        trail.record(read("zarr.get", "cloud_1"), "later")
        trail.flush(everything=True)
    assert [count for _, _, count in counted(sqlite_tables)] == [1, 2999, 1, 1, 1]


def counted(database: Database) -> list[tuple[str, str, int]]:
    query = sa.select(AuditEntry.action, AuditEntry.target, AuditEntry.count).order_by(AuditEntry.id)
    with database.session() as session:
        return [(action, target, count) for action, target, count in session.execute(query)]


def test_a_flood_of_refusals_is_bounded_and_counted_whole(sqlite_tables: Database, tmp_path: Path) -> None:
    trail = AuditTrail(sqlite_tables, load_settings(data_dir=tmp_path))
    for number in range(5000):
        trail.record(read("jobs.get", f"job_{number:026d}", 404), "c")
    # Another address is told apart, and reads go on.
    trail.record(read("jobs.get", KEYS[0], 404, address="b"), "c")
    trail.record(read("jobs.get", KEYS[1]), "c")
    trail.flush(everything=True)
    found = counted(sqlite_tables)
    assert len(found) == MOST_REFUSED + 4
    assert sum(count for _, _, count in found) == 5002
    assert sum(count for action, _, count in found if action == SEVERAL) == 5000 - MOST_REFUSED


def test_a_flood_from_many_addresses_is_bounded_too(sqlite_tables: Database, tmp_path: Path) -> None:
    trail = AuditTrail(sqlite_tables, load_settings(data_dir=tmp_path))
    with mock.patch.object(audit_trail, "MOST_KINDS", 100):
        for number in range(1000):
            trail.record(read("request", "", 401, actor="", address=f"a{number}"), "c")
    trail.flush(everything=True)
    found = counted(sqlite_tables)
    assert len(found) <= 103
    assert sum(count for _, _, count in found) == 1000


def test_a_full_queue_refuses_requests_instead_of_dropping_entries(service: Running) -> None:
    client = service.client()
    trail: AuditTrail = service.app.state.context.trail
    away = DatabaseUnavailableError("away", advice="")
    with (
        mock.patch.object(trail, "flush", side_effect=away),
        mock.patch.object(audit_trail, "MOST_WAITING", 3),
        mock.patch.object(audit_trail, "PATIENCE_SECONDS", 0.2),
    ):
        statuses = [client.get("/v1/jobs", params={"limit": str(n)}).status_code for n in (1, 2)]
        statuses += [client.get(f"/v1/acquisitions/{key}").status_code for key in KEYS]
        refused = client.get("/v1/session")
        assert client.get("/healthz").status_code == 200
    assert statuses[0] == 200
    assert refused.status_code == 503
    assert refused.json()["code"] == "database_unavailable"
    # What waited is written once it can be.
    assert {"jobs.list", "acquisitions.get"} <= {entry["action"] for entry in entries(client, kind="access")}


def test_what_was_answered_is_in_a_sealed_chain_when_the_service_has_ended(any_database: str, tmp_path: Path) -> None:
    with serving(tmp_path / "service", database_url=any_database, audit_key="k" * 32) as running:
        client = running.client()
        for _ in range(20):
            client.get("/v1/jobs")
        settings = running.settings
    database = Database.open(settings.database)
    verified = verify(database, ChainKeys.of(settings))
    assert (verified.unsealed, verified.fault) == (0, None)
    with database.session() as session:
        actions = session.execute(sa.select(AuditEntry.action, AuditEntry.count).order_by(AuditEntry.seq)).all()
    database.close()
    assert [tuple(row) for row in actions] == [
        ("service.start", 1),
        ("jobs.list", 1),
        ("service.stop", 1),
        ("jobs.list", 19),
    ]


def test_entries_are_written_soon_without_being_asked_for(service: Running) -> None:
    service.client().get("/v1/jobs")
    deadline = time.monotonic() + 10
    query = sa.select(AuditEntry.seq).where(AuditEntry.action == "jobs.list")
    seq = None
    while seq is None and time.monotonic() < deadline:
        time.sleep(0.05)
        with service.database.session() as session:
            seq = session.scalar(query)
    assert seq is not None


@pytest.mark.parametrize(("mode", "kept"), [("full", "127.0.0.1"), ("none", "")])
def test_addresses_are_kept_as_the_settings_say(tmp_path: Path, mode: str, kept: str) -> None:
    with serving(tmp_path / "service", audit_addresses=mode) as running:
        client = running.client()
        client.get("/v1/jobs")
        assert told(entries(client, kind="access", action="jobs.list"), "address") == [(kept,)]

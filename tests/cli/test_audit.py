"""``specimap audit``: what it prints, and how it ends."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from specimap_infra.audit.triggers import drop_triggers
from specimap_infra.database import Database
from specimap_infra.migrate import migrate
from specimap_infra.settings import load_settings
from specimap_infra.tables import AuditEntry
from tests.support.backup_scene import specimap, started


def service_with(folder: Path, count: int) -> tuple[dict[str, Any], Database]:
    database = Database.open(load_settings(data_dir=folder).database)
    migrate(database)
    with database.session() as session:
        session.add_all(
            AuditEntry(key_id="k", project_id="p", action="jobs.get", target=f"t{n}", details={}, correlation_id="")
            for n in range(count)
        )
    return {"data_dir": folder}, database


def test_head_verify_and_export(tmp_path: Path) -> None:
    given, database = service_with(tmp_path / "data", 4)
    unsealed = json.loads(specimap(given, "audit", "verify", "--json").stdout.splitlines()[-1])
    assert (unsealed["event"], unsealed["records"], unsealed["unsealed"]) == ("verified", 0, 4)
    anchor = specimap(given, "audit", "head").stdout.strip()
    assert anchor.startswith("4:sha256:")
    done = specimap(given, "audit", "verify", "--anchor", anchor)
    assert (done.returncode, done.stdout) == (0, "4 records, 1 to 4; 0 entries wait to be sealed.\n")
    lines = specimap(given, "audit", "export", "--format", "jsonl").stdout.splitlines()
    assert [json.loads(line)["target"] for line in lines] == ["t0", "t1", "t2", "t3"]
    out = tmp_path / "trail.xml"
    done = specimap(given, "audit", "export", "--format", "dicom", "--since", "2026-01-01", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert out.read_text("utf-8").count("<AuditMessage>") == 4
    assert specimap(given, "audit", "export", "--format", "jsonl", "--since", "2100-01-01").stdout == ""
    # A keyed chain is not verified without its key.
    with database.engine.begin() as connection:
        drop_triggers(connection)
        connection.exec_driver_sql("UPDATE audit SET target = 'other' WHERE seq = 3")
    database.close()
    broken = specimap(given, "audit", "verify")
    assert (broken.returncode, broken.stdout) == (1, "Record 3 is changed: the record is not what its hash is over.\n")


def test_what_is_refused(tmp_path: Path) -> None:
    given, database = service_with(tmp_path / "data", 1)
    database.close()
    wrong = specimap(given, "audit", "verify", "--anchor", "x")
    assert (wrong.returncode, "SEQ:HASH" in wrong.stderr) == (2, True)
    nowhere = specimap(given, "audit", "forward", "--once")
    assert (nowhere.returncode, "SPECIMAP_AUDIT_SYSLOG" in nowhere.stderr) == (2, True)
    short = specimap({**given, "audit_key": "short"}, "audit", "head")
    assert (short.returncode, "32 characters" in short.stderr) == (2, True)
    none = specimap({"data_dir": tmp_path / "other"}, "audit", "verify")
    assert none.returncode == 2


@pytest.mark.slow
@pytest.mark.waits
def test_what_was_answered_a_second_ago_outlives_a_killed_service(tmp_path: Path) -> None:
    given = {"data_dir": tmp_path / "data", "port": 0, "min_free_bytes": 0}
    key = specimap(given, "keys", "create", "--name", "reader", "--scope", "read").stdout.strip()
    with started(given, "serve", "--no-worker") as program:
        assert program.stdout is not None
        url = next(line.split()[-1] for line in program.stdout if "listens on" in line)
        for path in ("/v1/jobs", "/v1/clouds"):
            answer = httpx.get(url + path, headers={"Authorization": f"Bearer {key}"}, trust_env=False)
            assert answer.status_code == 200
        assert httpx.get(f"{url}/v1/keys", trust_env=False).status_code == 401
        time.sleep(2)
        program.kill()
        program.wait(20)
    lines = specimap(given, "audit", "export", "--format", "jsonl").stdout.splitlines()
    actions = [json.loads(line)["action"] for line in lines]
    assert actions == ["key.create", "service.start", "jobs.list", "clouds.list", "keys.list"]
    assert specimap(given, "audit", "verify").returncode == 0

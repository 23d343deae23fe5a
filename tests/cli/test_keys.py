"""``specimap keys`` as a person types it, on a database that may not be there yet."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from tests.support.scenes import Answer, specimap
from tests.support.service_scene import serving

PROGRAM = "from specimap_cli import main; main()"


def environment(folder: Path, database_url: str) -> dict[str, str]:
    others = {name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")}
    return others | {"SPECIMAP_DATA_DIR": str(folder), "SPECIMAP_DATABASE_URL": database_url}


def started(folder: Path, *arguments: str, database_url: str = "") -> Answer:
    """What the program says in a process of its own, as at a shell."""
    command = [sys.executable, "-W", "error", "-c", PROGRAM, *arguments]
    own = environment(folder, database_url)
    done = subprocess.run(command, env=own, capture_output=True, text=True, timeout=120)
    return Answer(done.returncode, done.stdout, done.stderr)


def keys(folder: Path, *arguments: str, database_url: str = "", program: str = "keys") -> Answer:
    """The same in this process, since an interpreter's start takes longer than a command."""
    with mock.patch.dict(os.environ, environment(folder, database_url), clear=True):
        return specimap(program, *arguments)


def listed(folder: Path, database_url: str = "") -> list[dict[str, Any]]:
    done = keys(folder, "list", "--json", database_url=database_url)
    assert done.status == 0, done.err
    return [json.loads(line) for line in done.out.splitlines()]


@pytest.mark.slow
def test_key_is_made_before_the_first_start_and_opens_the_service(tmp_path: Path, any_database: str) -> None:
    wanted = ("--name", "tablet 3", "--scope", "read", "--scope", "upload")
    done = started(tmp_path, "keys", "create", *wanted, database_url=any_database)
    assert done.status == 0, done.err
    key = done.out.removesuffix("\n")
    assert key.startswith("spk_")
    assert "\n" not in key
    assert key not in done.err
    (row,) = listed(tmp_path, any_database)
    assert {name: row[name] for name in ("name", "scopes", "state", "last_used_at")} == {
        "name": "tablet 3",
        "scopes": ["upload", "read"],
        "state": "valid",
        "last_used_at": None,
    }
    assert key not in json.dumps(row)
    with serving(tmp_path, database_url=any_database) as service:
        client = service.client(["read"])
        client.headers["Authorization"] = f"Bearer {key}"
        assert client.get("/v1/jobs").status_code == 200
        assert client.get("/v1/keys").status_code == 403
        revoked = keys(tmp_path, "revoke", str(row["id"]), database_url=any_database)
        assert (revoked.status, revoked.out) == (0, "")
        service.app.state.keyring.forget()
        assert client.get("/v1/jobs").status_code == 401
        audited = service.client().get("/v1/audit", params={"target": row["id"]}).json()["items"]
        assert [(e["action"], e["key_id"]) for e in audited] == [("key.revoke", "cli"), ("key.create", "cli")]
    assert listed(tmp_path, any_database)[0]["state"] == "revoked"


def test_projects_are_made_and_keys_are_made_for_them(tmp_path: Path) -> None:
    def projects(*arguments: str) -> Answer:
        return keys(tmp_path, *arguments, program="projects")

    made = projects("create", "study-7")
    assert made.status == 0, made.err
    project = made.out.strip()
    taken = projects("create", "study-7")
    assert (taken.status, taken.out) == (2, "")
    assert taken.err.startswith("state_conflict: ")
    assert projects("create", "study-9\n").err.startswith("setting_invalid: ")
    assert projects("rename", "study-7", "Anna Muster").err.startswith("setting_invalid: ")
    assert projects("rename", "study-7", "study-8").status == 0
    rows = [json.loads(line) for line in projects("list", "--json").out.splitlines()]
    assert [row["name"] for row in rows] == ["default", "study-8"]
    assert rows[1]["id"] == project
    assert f"{project}  study-8" in projects("list").out
    for wanted in ("study-8", project):
        done = keys(tmp_path, "create", "--name", "a", "--scope", "upload", "--project", wanted)
        assert done.status == 0, done.err
        assert "study-8" in done.err
    unknown = keys(tmp_path, "create", "--name", "a", "--scope", "read", "--project", "study-7")
    assert (unknown.status, unknown.out) == (2, "")
    assert unknown.err.startswith("not_found: ")
    keys(tmp_path, "create", "--name", "b", "--scope", "intraoperative")
    assert [(row["project"], row["scopes"]) for row in listed(tmp_path)] == [
        ("study-8", ["upload"]),
        ("study-8", ["upload"]),
        ("default", ["intraoperative"]),
    ]
    with serving(tmp_path) as service:
        administrator = service.client()
        audited = administrator.get("/v1/audit", params={"project": project}).json()["items"]
        assert {entry["key_id"] for entry in audited} == {"cli"}
        actions = [entry["action"] for entry in audited]
        assert actions == ["key.create", "key.create", "project.rename", "project.create"]


def test_expiry_and_table(tmp_path: Path) -> None:
    later = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=400)
    done = keys(tmp_path, "create", "--name", "x" * 90, "--scope", "admin", "--expires", f"{later:%Y-%m-%d}")
    assert done.status == 0, done.err
    (row,) = listed(tmp_path)
    assert row["expires_at"] == f"{later:%Y-%m-%d}T00:00:00+00:00"
    table = keys(tmp_path, "list").out
    assert str(row["id"]) in table
    assert "x" * 90 in table
    assert done.out.strip().rsplit("_", 1)[1] not in table


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["create", "--name", "a", "--scope", "root"], "root"),
        (["create", "--name", "a"], "--scope"),
        (["create", "--name", "", "--scope", "read"], "setting_invalid"),
        (["create", "--name", "a\x1b[31m", "--scope", "read"], "setting_invalid"),
        (["create", "--name", "a\udcff", "--scope", "read"], "setting_invalid"),
        (["create", "--name", "a", "--scope", "read", "--expires", "2020-01-01"], "has passed"),
        (["create", "--name", "a", "--scope", "read", "--expires", "soon"], "--expires"),
        (["revoke", "key_" + "0" * 26], "not_found"),
    ],
)
def test_what_cannot_be_is_refused_with_advice(tmp_path: Path, arguments: list[str], told: str) -> None:
    done = keys(tmp_path, *arguments)
    assert (done.status, done.out) == (2, "")
    assert told in done.err
    assert "Traceback" not in done.err


def test_database_that_does_not_answer_is_told(tmp_path: Path) -> None:
    done = keys(tmp_path, "list", database_url="postgresql://nobody@127.0.0.1:1/none")
    assert done.status == 2
    assert done.err.startswith("database_unavailable: ")
    assert "Traceback" not in done.err


def test_a_file_that_is_no_database_is_told_and_left(tmp_path: Path) -> None:
    file = tmp_path / "specimap.db"
    file.write_bytes(b"a letter, not a database. " * 100)
    done = keys(tmp_path, "list")
    assert done.status == 2
    assert done.err.startswith("database_damaged: ")
    assert "SPECIMAP_DATA_DIR" in done.err
    assert file.read_bytes() == b"a letter, not a database. " * 100


def test_a_data_folder_that_is_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("")
    done = keys(tmp_path / "data", "list")
    assert done.status == 2
    assert done.err.startswith("output_not_writable: ")

"""Settings: where they come from, what wins, what is refused and by which name, and the page that lists them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from specimap_core.errors import SettingsError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES
from specimap_infra.settings import OTHER_VARIABLES, ServiceSettings, known_variables, load_settings
from specimap_infra.settings_table import backends_table, page_part, settings_table
from tests.support.places import ROOT


@pytest.fixture(autouse=True)
def _bare_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("SPECIMAP_"):
            monkeypatch.delenv(name)


def refused(**given: object) -> SettingsError:
    with pytest.raises(SettingsError) as caught:
        load_settings(**given)
    assert caught.value.code == "setting_invalid"
    assert caught.value.advice
    return caught.value


def test_without_anything_all_lies_in_one_folder_and_loopback_alone_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", "/somewhere")
    settings = load_settings()
    assert settings.data_dir == Path("/somewhere/specimap")
    assert settings.database == "sqlite:////somewhere/specimap/specimap.db"
    assert settings.storage_place == "/somewhere/specimap/storage"
    assert settings.scratch == Path("/somewhere/specimap/scratch")
    assert (settings.host, settings.port) == ("127.0.0.1", 8765)
    assert settings.webhook_hosts == []


def test_values_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_PORT", "9000")
    monkeypatch.setenv("SPECIMAP_UPLOAD_HOURS", "1.5")
    monkeypatch.setenv("SPECIMAP_WEBHOOK_HOSTS", '["lis.example", "pacs.example"]')
    monkeypatch.setenv("SPECIMAP_DATABASE_URL", "postgresql://u:p@db/specimap")
    monkeypatch.setenv("SPECIMAP_SCRATCH_DIR", "/fast/scratch")
    settings = load_settings()
    assert settings.port == 9000
    assert settings.upload_hours == 1.5
    assert settings.webhook_hosts == ["lis.example", "pacs.example"]
    assert settings.database == "postgresql+psycopg://u:p@db/specimap"
    assert settings.scratch == Path("/fast/scratch")


def test_values_come_from_a_file_and_the_environment_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "specimap.toml"
    file.write_text('port = 9000\nlog_level = "debug"\nwebhook_hosts = ["lis.example"]\nslots = 2\n', "utf-8")
    monkeypatch.setenv("SPECIMAP_CONFIG", str(file))
    monkeypatch.setenv("SPECIMAP_PORT", "9001")
    settings = load_settings(slots=3)
    assert settings.port == 9001
    assert settings.slots == 3
    assert settings.log_level == "debug"
    assert settings.webhook_hosts == ["lis.example"]


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("PORT", "http", "integer"),
        ("PORT", "70000", "65535"),
        ("SLOTS", "0", "greater than or equal to 1"),
        ("DATABASE_URL", "mysql://db", "postgresql://"),
        ("STORAGE", "ftp://store", "s3://"),
        ("STORAGE", "s3://", "s3://BUCKET"),
        ("LOG_LEVEL", "loud", "'info'"),
        ("JUDGE_MEMORY_BYTES", "1000", "268435456"),
        ("OIDC_ISSUER", "http://login.test", "https://"),
        ("OIDC_ISSUER", "https://login.test?x=1", "without a query"),
        ("OIDC_ISSUER", "https://login.test", "SPECIMAP_OIDC_CLIENT_ID"),
        ("OIDC_SCOPES", "profile", "openid"),
        ("OIDC_ALGORITHMS", '["RS256", "HS256"]', "RS256"),
        ("OIDC_ALGORITHMS", '["none"]', "RS256"),
        ("OIDC_ALGORITHMS", "[]", "RS256"),
        ("OIDC_ROLES", '{"lab": "surgeon"}', "technician"),
        ("OIDC_CLOCK_SKEW_SECONDS", "3600", "300"),
    ],
)
def test_a_wrong_value_is_refused_by_its_variables_name(
    name: str, value: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(f"SPECIMAP_{name}", value)
    error = refused()
    assert error.message.startswith(f"SPECIMAP_{name}: ")
    assert says in error.message


def test_a_provider_needs_the_address_to_which_it_sends_people_back(monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"oidc_issuer": "https://login.test", "oidc_client_id": "specimap"}
    assert "SPECIMAP_PUBLIC_URL" in refused(**given).message
    assert "SPECIMAP_PUBLIC_URL" in refused(**given, public_url="http://specimap.test").message
    settings = load_settings(**given, public_url="https://specimap.test", oidc_client_secret="hidden")
    assert settings.oidc_issuer == "https://login.test"
    assert "hidden" not in repr(settings)
    monkeypatch.setenv("SPECIMAP_OIDC_ROLES", '{"lab": "technician"}')
    assert load_settings().oidc_roles == {"lab": "technician"}


def test_a_list_that_is_no_json_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_WEBHOOK_HOSTS", "lis.example,pacs.example")
    assert "webhook_hosts" in refused().message


def test_a_lease_shorter_than_two_heartbeats_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_HEARTBEAT_SECONDS", "8")
    assert refused().message == "SPECIMAP_LEASE_SECONDS: is at least twice SPECIMAP_HEARTBEAT_SECONDS."
    assert refused(heartbeat_seconds=1.0, lease_seconds=1.5).details["setting"] == "lease_seconds"


def test_an_unknown_variable_is_refused_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_DATABASE_URI", "sqlite:///x.db")
    error = refused()
    assert error.message == "There is no setting SPECIMAP_DATABASE_URI."
    assert error.details["setting"] == "SPECIMAP_DATABASE_URI"


def test_variables_with_the_prefix_that_are_no_settings_are_let_be(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in OTHER_VARIABLES - {"SPECIMAP_CONFIG"}:
        monkeypatch.setenv(name, "x")
    assert load_settings().port == 8765


def test_variables_of_backends_are_let_be_where_they_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    right = {
        "DEVICE": "cpu",
        "GRAPH": "swin-5",
        "SIZE_PX": "224",
        "SUBSAMPLE": "4",
        "SCHEDULE": "50,50",
        "CONFIDENCE": "2",
        "BATCH": "4",
    }
    for name in BACKEND_VARIABLES:
        monkeypatch.setenv(name, right.get(re.sub(r"SPECIMAP_(MAST3R|DA3|DENSE)_", "", name), "/x"))
    assert load_settings().port == 8765


@pytest.mark.parametrize("name", ["SPECIMAP_MAST3R_GRAPH", "SPECIMAP_DA3_BATCH", "SPECIMAP_DENSE_DEVICE"])
def test_a_wrong_value_of_a_backends_variable_is_refused_by_its_name(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "many")
    error = refused()
    assert error.message == f"{name} is 'many'."
    assert error.details["setting"] == name


def test_a_gpu_for_the_default_backends_depth_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_DENSE_DEVICE", "gpu")
    error = refused()
    assert (error.code, error.details["setting"]) == ("setting_invalid", "SPECIMAP_DENSE_DEVICE")
    assert error.advice.startswith("Remove it: depth is measured on the CPU")


def test_a_variable_that_only_looks_like_a_backends_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPECIMAP_MAST3R_WIEGHTS", "/x")
    assert refused().message == "There is no setting SPECIMAP_MAST3R_WIEGHTS."


def test_a_file_with_an_unknown_setting_is_refused_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "specimap.toml"
    file.write_text("prot = 9000\n", "utf-8")
    monkeypatch.setenv("SPECIMAP_CONFIG", str(file))
    assert refused().message.startswith("SPECIMAP_PROT: ")


def test_a_file_that_is_no_toml_or_not_there_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "specimap.toml"
    monkeypatch.setenv("SPECIMAP_CONFIG", str(file))
    assert refused().message == f"SPECIMAP_CONFIG names {file}, which does not exist."
    file.write_text("port: 9000\n", "utf-8")
    assert "do not read" in refused().message


# ---- the page -----------------------------------------------------------------------------------------


def test_the_page_holds_the_tables_as_the_module_prints_them() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "specimap_infra.settings_table"], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == page_part() + "\n"
    page = (ROOT / "docs" / "settings.md").read_text("utf-8")
    assert done.stdout in page, "print it anew: python -m specimap_infra.settings_table"


def test_the_table_lists_every_setting_once_with_its_meaning() -> None:
    rows = re.findall(r"^\| `SPECIMAP_(\w+)` \| (.*) \| (.+) \| (.+) \|$", settings_table(), re.MULTILINE)
    assert [name.lower() for name, *_ in rows] == list(ServiceSettings.model_fields)
    for _, _, takes, meaning in rows:
        assert takes
        assert meaning.endswith(".")


def test_the_table_of_backends_lists_every_variable_with_its_meaning() -> None:
    rows = re.findall(r"^\| `(SPECIMAP_\w+)` \| ([^|]+\.) \|$", backends_table(), re.MULTILINE)
    assert [name for name, _ in rows] == list(BACKEND_VARIABLES)
    assert {"SPECIMAP_MAST3R_WEIGHTS", "SPECIMAP_DA3_WEIGHTS", "SPECIMAP_DENSE_DEVICE"} < set(BACKEND_VARIABLES)


def test_the_tables_cells_say_what_the_settings_say() -> None:
    table = settings_table()
    assert "| `SPECIMAP_PORT` | 8765 | whole number, at least 0, at most 65535 |" in table
    assert "| `SPECIMAP_MAX_PHOTO_BYTES` | 67108864 (64 MiB) | whole number, at least 1 |" in table
    assert "| `SPECIMAP_LOG_FORMAT` | `json` | `json`, `text` |" in table
    assert "| `SPECIMAP_UPLOAD_HOURS` | 48 | number, above 0 |" in table
    assert "| `SPECIMAP_WEBHOOK_HOSTS` | `[]` | a JSON list of text |" in table
    assert "| `SPECIMAP_DATA_DIR` | `$XDG_DATA_HOME/specimap`, else `~/.local/share/specimap` | a folder |" in table


def test_all_variables_that_pages_and_images_name_exist() -> None:
    prefixes = {"SPECIMAP_MAST3R_", "SPECIMAP_DA3_"}  # a page's table lists what follows them
    known = known_variables() | prefixes
    docker = [file for folder in ("docker", "docker/proxy") for file in (ROOT / folder).glob("*") if file.is_file()]
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *docker]
    for file in files:
        for name in re.findall(r"\bSPECIMAP_[A-Z][A-Z0-9_]*\b", file.read_text("utf-8")):
            assert name in known or name == "SPECIMAP_NAME", f"{file.name} names {name}"


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"pacs_host": "pacs.example"}, "SPECIMAP_PACS_HOST"),
        ({"pacs_password": "secret"}, "SPECIMAP_PACS_PASSWORD"),
        ({"pacs_token": "a", "pacs_user": "b", "pacs_password": "c"}, "SPECIMAP_PACS_USER"),
        ({"worklist_host": "ris.example"}, "SPECIMAP_WORKLIST_HOST"),
        ({"fhir_token_url": "https://fhir.example/token"}, "SPECIMAP_FHIR_TOKEN_URL"),
        ({"hospital_ca_file": "/nowhere/ca.pem"}, "SPECIMAP_HOSPITAL_CA_FILE"),
        ({"dicom_port": 11112, "dicom_tls": "on"}, "SPECIMAP_DICOM_TLS"),
    ],
)
def test_settings_that_need_others_are_refused_without_them(given: dict[str, Any], named: str) -> None:
    with pytest.raises(SettingsError) as caught:
        load_settings(**given)
    assert named in caught.value.message
    assert "secret" not in str(caught.value.as_dict())

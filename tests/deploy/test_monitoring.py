"""Alert rules and dashboard: they ask for metrics that the service has, and the rules fire when they should."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa
import yaml
from prometheus_client.parser import text_string_to_metric_families

from specimap_infra.database import utc_now
from specimap_infra.tables import Lease
from specimap_service.http_status import HTTP_STATUS
from tests.support.places import ROOT
from tests.support.service_scene import serving

MONITORING = ROOT / "docker" / "monitoring"
RULES = MONITORING / "alerts.yaml"
PROMTOOL = shutil.which("promtool")
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_count", "_sum"), "gauge": ("",)}
OF_OTHERS = {"up"}
"""Prometheus' own."""


def names_in(expression: str) -> set[str]:
    """Names of metrics in a PromQL expression: what stands before a selector, or alone, and begins as ours do."""
    bare = re.sub(r'"[^"]*"', "", expression)
    return set(re.findall(r"\b(specimap_\w+|up)\b", bare))


def expressions() -> Iterator[tuple[str, str]]:
    """Every expression, with where it stands."""
    for group in yaml.safe_load(RULES.read_text("utf-8"))["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]
    for panel in json.loads((MONITORING / "dashboard.json").read_text("utf-8"))["panels"]:
        for target in panel["targets"]:
            yield panel["title"], target["expr"]


@pytest.fixture(scope="module")
def scraped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Names of all series that a running service has, with the names of their labels."""
    with serving(tmp_path_factory.mktemp("service")) as service:
        client = service.client()
        client.get("/v1/jobs")
        text = client.get("/metrics").text
    found: dict[str, set[str]] = {}
    for family in text_string_to_metric_families(text):
        for suffix in SUFFIXES[family.type]:
            found.setdefault(family.name + suffix, set())
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


def test_every_expression_asks_for_metrics_that_the_service_has(scraped: dict[str, set[str]]) -> None:
    asked = {name for _, expression in expressions() for name in names_in(expression)}
    assert len(asked) > 8
    assert asked - OF_OTHERS <= set(scraped)


def test_labels_of_the_expressions_are_those_of_the_metrics(scraped: dict[str, set[str]]) -> None:
    matched = 0
    for where, expression in expressions():
        for name, selector in re.findall(r"\b(specimap_\w+)\{([^}]*)\}", expression):
            labels = set(re.findall(r"(\w+)=~?\"", selector))
            # Those of a counter of failures show once a job has failed.
            if scraped[name]:
                assert labels <= scraped[name] | {"code"}, where
                matched += 1
    assert matched > 5


def test_codes_in_the_rules_are_codes_of_errors() -> None:
    (codes,) = re.findall(r'code=~"([^"]+)"', RULES.read_text("utf-8"))
    assert set(codes.split("|")) <= {leaf.code for leaf in HTTP_STATUS}


def test_dashboard_is_one_that_grafana_takes() -> None:
    dashboard = json.loads((MONITORING / "dashboard.json").read_text("utf-8"))
    assert dashboard["uid"] == "specimap"
    assert [variable["name"] for variable in dashboard["templating"]["list"]] == ["datasource"]
    panels = dashboard["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels) > 10
    taken: set[tuple[int, int]] = set()
    for panel in panels:
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24
        taken |= cells
        assert {target["datasource"]["uid"] for target in panel["targets"]} == {"${datasource}"}


@pytest.mark.skipif(PROMTOOL is None, reason="there is no promtool: apt-get install prometheus")
@pytest.mark.parametrize("arguments", [("check", "rules", "alerts.yaml"), ("test", "rules", "alerts_test.yaml")])
def test_rules_fire_when_they_should(arguments: tuple[str, ...]) -> None:
    assert PROMTOOL is not None
    done = subprocess.run([PROMTOOL, *arguments], cwd=MONITORING, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_rule_is_tested() -> None:
    alerts = {name for name, _ in expressions() if name.startswith("Specimap")}
    tests = (MONITORING / "alerts_test.yaml").read_text("utf-8")
    for name in alerts:
        assert tests.count(name) >= 2, f"{name} is not tested both ways"


def test_a_lease_that_nobody_removed_is_no_worker(tmp_path: Path) -> None:
    with serving(tmp_path) as service:
        now = utc_now().timestamp()
        with service.database.session() as session:
            for name, beat in (("old", now - 3600), ("new", now + 60)):
                session.execute(
                    sa.insert(Lease).values(executor=f"h:0:{name}", host="h", kind="cpu", started=beat, heartbeat=beat)
                )
        lines = service.client().get("/metrics").text.splitlines()
    assert "specimap_workers 1.0" in lines

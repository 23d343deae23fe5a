"""The manifests for Kubernetes, rendered by kustomize as `kubectl apply --kustomize` does, and judged."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from specimap_infra.settings import load_settings
from tests.support.places import ROOT

KUBERNETES = ROOT / "docker" / "kubernetes"
OVERLAYS = ("one-machine", "many", "gpu")
KUBECTL = shutil.which("kubectl")
VERSIONS = ("1.32", "1.37")
"""The oldest and the newest release whose schemas are checked."""
OF_OPERATORS = {"ScaledObject", "TriggerAuthentication", "ServiceMonitor", "PrometheusRule"}
"""Kinds that KEDA and the operator of Prometheus bring."""
SECRETS = {"specimap-secrets", "specimap-metrics-key", "specimap-tls"}
NOBODYS = "192.0.2.0/24"
"""What an installation has to replace (RFC 5737)."""

pytestmark = pytest.mark.skipif(KUBECTL is None, reason="there is no kubectl")


@cache
def rendered(folder: Path) -> tuple[dict[str, Any], ...]:
    assert KUBECTL is not None
    done = subprocess.run([KUBECTL, "kustomize", str(folder)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return tuple(yaml.safe_load_all(done.stdout))


def objects(overlay: str) -> tuple[dict[str, Any], ...]:
    return rendered(KUBERNETES / "overlays" / overlay)


def named(overlay: str, kind: str, name: str) -> dict[str, Any]:
    (found,) = [each for each in objects(overlay) if (each["kind"], each["metadata"]["name"]) == (kind, name)]
    return found


def pods(overlay: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Kind, component and specification of every pod."""
    for each in objects(overlay):
        if each["kind"] in ("Deployment", "Job", "CronJob"):
            template = (each["spec"]["jobTemplate"] if each["kind"] == "CronJob" else each)["spec"]["template"]
            yield each["kind"], template["metadata"]["labels"]["app.kubernetes.io/component"], template["spec"]


def containers(overlay: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for kind, component, pod in pods(overlay):
        assert "initContainers" not in pod
        for container in pod["containers"]:
            yield kind, component, container


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("overlay", OVERLAYS)
def test_every_object_is_what_kubernetes_asks_for(overlay: str, version: str) -> None:
    checked = 0
    for each in objects(overlay):
        if each["kind"] not in OF_OPERATORS:
            kubernetes_validate.validate(each, version, strict=True)
            checked += 1
    assert checked >= 14


def test_what_is_wrong_is_found() -> None:
    wrong = {**named("many", "Deployment", "api"), "spce": {}}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, VERSIONS[0], strict=True)


def test_overlays_have_the_parts_that_they_name() -> None:
    parts = {overlay: {component for _, component, _ in pods(overlay)} for overlay in OVERLAYS}
    assert parts["one-machine"] == {"api", "worker", "migrate", "backup"}
    assert parts["many"] == {"api", "worker", "migrate", "backup", "hospital"}
    assert parts["gpu"] == parts["many"] | {"worker-gpu"}


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_no_pod_has_a_right_that_it_does_not_need(overlay: str) -> None:
    """What Kubernetes calls restricted, a read-only root, and no token."""
    labels = named(overlay, "Namespace", "specimap")["metadata"]["labels"]
    assert labels["pod-security.kubernetes.io/enforce"] == "restricted"
    for _, component, pod in pods(overlay):
        assert pod["automountServiceAccountToken"] is False, component
        assert pod["serviceAccountName"] == "specimap"
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] == pod["securityContext"]["fsGroup"] == 10001
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod)
        assert not any("hostPath" in volume for volume in pod["volumes"])
    for _, component, container in containers(overlay):
        context = container["securityContext"]
        assert context["allowPrivilegeEscalation"] is False, component
        assert context["readOnlyRootFilesystem"] is True
        assert context["privileged"] is False
        assert context["capabilities"] == {"drop": ["ALL"]}
    assert not {each["kind"] for each in objects(overlay)} & {
        "Role",
        "ClusterRole",
        "RoleBinding",
        "ClusterRoleBinding",
    }


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_every_container_has_limits_and_what_goes_on_has_probes(overlay: str) -> None:
    for kind, component, container in containers(overlay):
        limits, requests = container["resources"]["limits"], container["resources"]["requests"]
        assert {"cpu", "memory"} <= set(limits) & set(requests), component
        if kind == "Deployment":
            assert {"startupProbe", "livenessProbe"} <= set(container), component
        if component == "api":
            assert container["livenessProbe"]["httpGet"]["path"] == "/healthz"
            assert container["readinessProbe"]["httpGet"]["path"] == "/readyz"
        elif kind == "Deployment":
            program = "hospital" if component == "hospital" else "worker"
            assert container["livenessProbe"]["exec"]["command"] == ["specimap", program, "--health"]


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_images_are_of_this_release(overlay: str) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    for _, component, container in containers(overlay):
        name = component if component.startswith("worker") else "service"
        target = {"worker": "worker-cpu"}.get(name, name)
        assert container["image"] == f"registry.example/specimap-{target}:{version}"
    assert named(overlay, "Job", f"migrate-{version.replace('.', '-')}")


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_secrets_are_named_and_never_written_down(overlay: str) -> None:
    assert "Secret" not in {each["kind"] for each in objects(overlay)}
    used: set[str] = set()
    for _, _, container in containers(overlay):
        assert "env" not in container
        for source in container["envFrom"]:
            used |= {source["secretRef"]["name"]} if "secretRef" in source else set()
    assert used == (set() if overlay == "one-machine" else {"specimap-secrets"})
    text = "".join(yaml.safe_dump(each) for each in objects(overlay))
    assert set(re.findall(r"(?:secretName: |secretRef:\s+name: )(\S+)", text)) <= SECRETS
    assert not re.search(r"(?i)postgresql://|aws_secret|password\s*[:=]", text)


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_settings_are_settings_and_kubernetes_adds_none(overlay: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (settings,) = [each["data"] for each in objects(overlay) if each["kind"] == "ConfigMap"]
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    assert load_settings().public_url == "https://specimap.example"
    for _, component, pod in pods(overlay):
        # A service named so-and-so would give each pod SPECIMAP_SO_AND_SO_PORT, which the program refuses.
        assert pod["enableServiceLinks"] is False, component


@pytest.mark.parametrize("overlay", OVERLAYS)
def test_network_is_closed_but_for_named_exceptions(overlay: str) -> None:
    policies = {each["metadata"]["name"]: each["spec"] for each in objects(overlay) if each["kind"] == "NetworkPolicy"}
    closed = policies.pop("default-deny")
    assert closed == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    for name, policy in policies.items():
        for rule in [*policy.get("ingress", []), *policy.get("egress", [])]:
            assert rule["ports"], name
            for end in [*rule.get("from", []), *rule.get("to", [])]:
                # Not everybody: pods of a namespace by its name, or addresses that an installation has to put in.
                if end.get("ipBlock", {}).get("cidr") != NOBODYS:
                    assert end.get("namespaceSelector", end.get("podSelector"))["matchLabels"], name
    reach_out = {name for name, policy in policies.items() if "Egress" in policy["policyTypes"]}
    assert reach_out == ({"dns"} if overlay == "one-machine" else {"dns", "data", "hospital-systems", "api-systems"})


def test_ingress_speaks_tls_alone_and_passes_large_bodies() -> None:
    for overlay in OVERLAYS:
        ingress = named(overlay, "Ingress", "api")
        (rule,), (tls,) = ingress["spec"]["rules"], ingress["spec"]["tls"]
        assert tls["hosts"] == [rule["host"]]
        annotations = {name.rsplit("/", 1)[1]: value for name, value in ingress["metadata"]["annotations"].items()}
        assert annotations["force-ssl-redirect"] == "true"
        assert annotations["proxy-request-buffering"] == annotations["proxy-buffering"] == "off"
        assert annotations["proxy-body-size"] == "10g"
    assert load_settings().max_cube_bytes < 10**10


def test_replicas_outlive_the_loss_of_one_and_sqlite_has_no_second() -> None:
    assert named("many", "Deployment", "api")["spec"]["replicas"] == 2
    assert named("many", "PodDisruptionBudget", "api")["spec"]["minAvailable"] == 1
    for name in ("api", "worker"):
        alone = named("one-machine", "Deployment", name)["spec"]
        assert alone["replicas"] == 1
        assert alone["strategy"] == {"type": "Recreate"}
    assert "PodDisruptionBudget" not in {each["kind"] for each in objects("one-machine")}
    shared = {
        component: [volume for volume in pod["volumes"] if volume["name"] == "data"]
        for _, component, pod in pods("one-machine")
    }
    assert set(map(str, shared.values())) == {str([{"name": "data", "persistentVolumeClaim": {"claimName": "data"}}])}


def test_workers_with_a_gpu_run_where_one_is() -> None:
    pod = named("gpu", "Deployment", "worker-gpu")["spec"]["template"]["spec"]
    assert pod["nodeSelector"] == {"nvidia.com/gpu.present": "true"}
    assert pod["tolerations"] == [{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}]
    assert pod["containers"][0]["resources"]["limits"]["nvidia.com/gpu"] == 1
    (weights,) = [volume for volume in pod["volumes"] if volume["name"] == "weights"]
    assert weights["persistentVolumeClaim"]["readOnly"] is True


def test_workers_follow_the_queue(sqlite_tables: Any) -> None:
    import sqlalchemy as sa

    scaled = named("many", "ScaledObject", "worker")["spec"]
    assert "replicas" not in named("many", "Deployment", "worker")["spec"]
    (trigger,) = scaled["triggers"]
    with sqlite_tables.session() as session:
        assert session.scalar(sa.text(trigger["metadata"]["query"])) == 0
    access = named("many", "TriggerAuthentication", "database")["spec"]["secretTargetRef"]
    assert {each["name"] for each in access} <= SECRETS


def test_the_other_autoscaler_fits_in_its_place(tmp_path: Path) -> None:
    shutil.copytree(KUBERNETES, tmp_path / "kubernetes")
    file = tmp_path / "kubernetes" / "overlays" / "many" / "kustomization.yaml"
    file.write_text(file.read_text("utf-8").replace("components/scale-keda", "components/scale-hpa"), "utf-8")
    made = rendered(file.parent)
    (scaler,) = [each for each in made if each["kind"] == "HorizontalPodAutoscaler"]
    kubernetes_validate.validate(scaler, VERSIONS[-1], strict=True)
    assert not {each["kind"] for each in made} & {"ScaledObject", "TriggerAuthentication"}
    assert scaler["spec"]["metrics"][0]["external"]["metric"]["name"] == "specimap_jobs"


def test_rules_are_those_of_the_file_for_prometheus() -> None:
    groups = named("many", "PrometheusRule", "specimap")["spec"]["groups"]
    assert groups[:1] == yaml.safe_load((ROOT / "docker" / "monitoring" / "alerts.yaml").read_text("utf-8"))["groups"]
    (more,) = groups[1:]
    assert [rule["alert"] for rule in more["rules"]] == ["SpecimapBackupOld"]
    monitor = named("many", "ServiceMonitor", "api")["spec"]
    assert monitor["selector"]["matchLabels"].items() <= named("many", "Service", "api")["metadata"]["labels"].items()
    assert monitor["endpoints"][0]["authorization"]["credentials"]["name"] in SECRETS
    assert named("many", "Service", "api")["metadata"]["labels"][monitor["jobLabel"]] == "specimap"


def test_backup_of_the_night_links_what_the_last_one_has(tmp_path: Path) -> None:
    (backup,) = [container for kind, _, container in containers("many") if kind == "CronJob"]
    *shell, script = backup["command"]
    assert shell == ["/bin/sh", "-euc"]
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "specimap"
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n', "ascii")
    program.chmod(0o755)
    store = tmp_path / "backups"
    store.mkdir()

    def given() -> list[str]:
        done = subprocess.run(
            [*shell, script.replace("/backups", str(store))],
            env={"PATH": f"{program.parent}:/usr/bin:/bin"},
            capture_output=True,
            text=True,
            check=True,
            timeout=20,
        )
        return done.stdout.split()

    first = given()
    assert first[:2] == ["backup", "--to"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d{4}", Path(first[2]).name)
    assert len(first) == 3
    for name in ("2027-03-01T0230", "2027-03-02T0230", ".2027-03-03T0230.tmp"):
        (store / name).mkdir()
    assert given()[3:] == ["--previous", str(store / "2027-03-02T0230")]


def test_every_part_is_used_somewhere() -> None:
    used = "".join(file.read_text("utf-8") for file in (KUBERNETES / "overlays").glob("*/kustomization.yaml"))
    for component in (KUBERNETES / "components").iterdir():
        assert component.name in used, component.name

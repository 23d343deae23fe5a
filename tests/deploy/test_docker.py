"""The images and compose files, checked without a Docker engine; `make check-images` builds and runs them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import compose_spec
import pytest
import yaml

from tests.support.places import ROOT

DOCKER = ROOT / "docker"
COMPOSE = ("compose.yaml", "compose.many.yaml")
IMAGES = {"service": "service", "worker-cpu": "workers", "worker-gpu": "workers"}
"""Targets of the Dockerfile and the extra that each installs."""
GIVEN = {"PUBLIC_HOST": "specimap.example", "POSTGRES_PASSWORD": "p0", "S3_ACCESS_KEY": "a0", "S3_SECRET_KEY": "s0"}
OURS = re.compile(r"^specimap-(service|worker-\w+):")


# ---- the Dockerfile -----------------------------------------------------------------------------------


def stages() -> dict[str, list[tuple[str, str]]]:
    """Instructions by stage; those before the first stage stand under ""."""
    text = re.sub(r"^\s*#.*\n", "", (DOCKER / "Dockerfile").read_text("utf-8"), flags=re.MULTILINE)
    made: dict[str, list[tuple[str, str]]] = {"": []}
    name = ""
    for line in re.sub(r"\\\n", " ", text).splitlines():
        if line.strip():
            word, _, rest = line.partition(" ")
            if word == "FROM":
                name = rest.split(" AS ")[1]
                made[name] = []
            made[name].append((word, " ".join(rest.split())))
    return made


def lineage(target: str) -> list[tuple[str, str]]:
    """All instructions that make a target, its bases' first."""
    own = stages()[target]
    base = own[0][1].split(" AS ")[0]
    return [*(lineage(base) if base in stages() else []), *own]


def built_from(target: str) -> Iterator[str]:
    """The target, its bases and the stages that it copies from."""
    yield target
    for word, rest in stages()[target]:
        source = rest.split(" AS ")[0] if word == "FROM" else (re.findall(r"--from=(\S+)", rest) or [""])[0]
        if source and source in stages():
            yield from built_from(source)


@pytest.mark.parametrize("target", IMAGES)
def test_an_image_runs_as_nobody_in_particular(target: str) -> None:
    instructions = lineage(target)
    assert [rest for word, rest in instructions if word == "USER"][-1] == "10001:10001"
    assert ("VOLUME", "/data") in instructions
    assert ("STOPSIGNAL", "SIGTERM") in instructions
    entry = [rest for word, rest in instructions if word == "ENTRYPOINT"][-1]
    assert entry == '["tini", "--", "specimap"]'
    assert any("SPECIMAP_DATA_DIR=/data" in rest for word, rest in instructions if word == "ENV")


@pytest.mark.parametrize("target", IMAGES)
def test_an_image_installs_its_own_extra_alone_at_the_locked_versions(target: str) -> None:
    installs = [
        command
        for stage in built_from(target)
        for word, rest in stages()[stage]
        if word == "RUN"
        for command in re.split(r"&&", rest)
        if " install " in command and "pip " in command
    ]
    extras = {extra for command in installs for extra in re.findall(r"\.whl\)?\[(\w+)\]", command)}
    assert extras == {IMAGES[target]}
    for command in installs:
        assert "--constraint requirements.lock" in command or "--no-deps --no-index" in command


def test_only_the_service_listens_and_the_health_of_all_is_asked_for() -> None:
    for target in IMAGES:
        ports = [rest for word, rest in lineage(target) if word == "EXPOSE"]
        health = [rest for word, rest in lineage(target) if word == "HEALTHCHECK"][-1]
        if target == "service":
            assert ports == ["8765"]
            assert "/healthz" in health
            assert ("CMD", '["serve", "--no-worker"]') in lineage(target)
        else:
            assert ports == []
            assert health.endswith('CMD ["specimap", "worker", "--health"]')


def test_nothing_is_fetched_by_address_and_no_secret_is_built_in() -> None:
    everything = [step for steps in stages().values() for step in steps]
    assert {word for word, _ in everything} <= {
        "ARG",
        "FROM",
        "ENV",
        "WORKDIR",
        "COPY",
        "RUN",
        "LABEL",
        "VOLUME",
        "STOPSIGNAL",
        "ENTRYPOINT",
        "CMD",
        "HEALTHCHECK",
        "EXPOSE",
        "USER",
    }
    for word, rest in everything:
        assert "://" not in rest or word == "HEALTHCHECK"
        assert not re.search(r"\b(curl|wget|git)\b", rest)
        if word in ("ENV", "ARG"):
            assert not re.search(r"(?i)password|secret|token|_key", rest)


def test_bases_are_pinned_and_versions_are_the_projects_own() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    (base,) = [rest for word, rest in stages()[""] if word == "ARG"]
    assert re.fullmatch(r"PYTHON_IMAGE=python:3\.\d+\.\d+-slim-\w+", base)
    assert any(f'image.version="{version}"' in rest for _, rest in stages()["runtime"])
    for name in COMPOSE:
        for image in re.findall(r"image: (\S+)", (DOCKER / name).read_text("utf-8")):
            if OURS.match(image):
                assert image.endswith(f":${{IMAGE_TAG:-{version}}}")
            else:
                assert re.fullmatch(r"[a-z/]+:v?\d+\.\d+(\.\d+)?(-\w+)?", image)


def test_a_worker_with_gpus_is_the_worker_that_sees_them() -> None:
    base, *own = stages()["worker-gpu"]
    assert base == ("FROM", "worker-cpu AS worker-gpu")
    assert {word for word, _ in own} == {"LABEL", "ENV", "CMD"}
    assert any("NVIDIA_VISIBLE_DEVICES=all" in rest for word, rest in own if word == "ENV")


def test_builder_is_sent_what_the_images_copy_and_no_more() -> None:
    lines = [line for line in (DOCKER / "Dockerfile.dockerignore").read_text("utf-8").splitlines() if line[:1] != "#"]
    assert lines[0] == "*"
    sent = {line[1:] for line in lines if line.startswith("!")}
    copied = {
        source
        for steps in stages().values()
        for word, rest in steps
        if word == "COPY" and "--from" not in rest
        for source in rest.split()[:-1]
    }
    # Files of a folder that is sent whole may be copied before the rest of it.
    early = {source for source in copied if source.partition("/")[0] in sent - {source}}
    assert copied - early == sent
    assert all((ROOT / name).exists() for name in sent)


def test_hadolint_finds_nothing() -> None:
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent)) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("there is no hadolint; it comes with the extra dev")
    done = subprocess.run(
        [hadolint, "--failure-threshold", "style", str(DOCKER / "Dockerfile")],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_script_is_valid_bash() -> None:
    subprocess.run(["bash", "-n", str(DOCKER / "check_images.sh")], check=True, timeout=20)
    assert os.access(DOCKER / "check_images.sh", os.X_OK)


# ---- compose ------------------------------------------------------------------------------------------


def filled_in(name: str, given: dict[str, str]) -> str:
    """The file with its variables in place, as Compose puts them. Raises KeyError for one that has to be given."""

    def value(match: re.Match[str]) -> str:
        variable, operator, rest = match["name"], match["operator"], match["rest"] or ""
        if found := given.get(variable):
            return found
        if operator == ":?":
            raise KeyError(variable)
        return rest

    text = re.sub(r"^\s*#.*\n", "", (DOCKER / name).read_text("utf-8"), flags=re.MULTILINE)
    pattern = re.compile(r"\$\{(?P<name>\w+)(?:(?P<operator>:[-?])(?P<rest>[^${}]*))?\}")
    while (changed := pattern.sub(value, text)) != text:
        text = changed
    return text


def services(name: str) -> dict[str, dict[str, Any]]:
    made: dict[str, dict[str, Any]] = yaml.safe_load(filled_in(name, GIVEN))["services"]
    return made


@pytest.mark.parametrize("name", COMPOSE)
def test_compose_file_is_what_the_specification_asks_for(name: str) -> None:
    # Anchors resolved beforehand: the reader stops at merges within merges.
    parts = {key: value for key, value in yaml.safe_load(filled_in(name, GIVEN)).items() if not key.startswith("x-")}
    read = compose_spec.PyCompose.from_yaml(yaml.safe_dump(parts))
    read.validate()
    assert set(read.service_names()) == set(services(name))
    mounted = {str(volume).split(":")[0] for each in services(name).values() for volume in each.get("volumes", [])}
    assert {place for place in mounted if place[0] not in "./"} == set(parts["volumes"])


@pytest.mark.parametrize("name", COMPOSE)
@pytest.mark.parametrize("profiles", ["", "tls", "data", "api", "worker", "gpu", "hospital", "data,api,worker"])
def test_compose_itself_takes_the_file(name: str, profiles: str) -> None:
    command = ["docker", "compose"]
    if not shutil.which("docker") or subprocess.run([*command, "version"], capture_output=True, timeout=60).returncode:
        pytest.skip("there is no docker compose")
    done = subprocess.run(
        [*command, "--file", str(DOCKER / name), "config", "--quiet"],
        env={**os.environ, **GIVEN, "COMPOSE_PROFILES": profiles},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("missing", GIVEN)
def test_start_is_refused_where_a_secret_or_the_name_is_not_given(missing: str) -> None:
    with pytest.raises(KeyError, match=missing):
        filled_in("compose.many.yaml", {name: value for name, value in GIVEN.items() if name != missing})


def test_example_names_every_variable_and_gives_no_secret() -> None:
    example = (DOCKER / "example.env").read_text("utf-8")
    named = dict(re.findall(r"^(?:# )?([A-Z][A-Z0-9_]*)=(.*)$", example, re.MULTILINE))
    used = {found for name in COMPOSE for found in re.findall(r"\$\{(\w+)", (DOCKER / name).read_text("utf-8"))}
    assert used - set(named) == {"IMAGE_TAG", "PORT", "WEIGHTS"}
    assert set(named) - used == {"COMPOSE_PROFILES"}
    assert [named[name] for name in GIVEN] == [""] * len(GIVEN)


GIVEN_BACK = {"proxy": ["NET_BIND_SERVICE"], "database": ["CHOWN", "DAC_OVERRIDE", "FOWNER", "SETGID", "SETUID"]}
"""Capabilities that an image of others needs to start."""
OPEN = {"proxy": "443:443"}


@pytest.mark.parametrize("name", COMPOSE)
def test_containers_are_locked_down_and_nothing_is_open_but_the_proxy(name: str) -> None:
    for service, parts in services(name).items():
        assert "no-new-privileges:true" in parts["security_opt"], service
        assert not parts.get("privileged")
        assert parts["read_only"] is True, service
        assert parts["cap_drop"] == ["ALL"], service
        assert parts.get("cap_add", []) == GIVEN_BACK.get(service, [])
        assert any(str(place).startswith("/tmp") for place in parts["tmpfs"]) or service == "proxy"
        assert parts["mem_limit"]
        assert parts["pids_limit"]
        for port in parts.get("ports", []):
            assert port.startswith("127.0.0.1:") or port == OPEN.get(service)


@pytest.mark.parametrize("name", COMPOSE)
def test_every_container_that_goes_on_has_a_health_check(name: str) -> None:
    for service, parts in services(name).items():
        ours = OURS.match(parts["image"])
        if service == "bucket":  # it ends
            assert parts["restart"] == "no"
        elif "healthcheck" in parts:
            assert parts["healthcheck"]["test"][0] == "CMD"
        else:  # that of the image, which is for the image's own command
            assert ours
            assert "command" not in parts


@pytest.mark.parametrize("name", COMPOSE)
def test_hospital_starts_only_where_it_is_asked_for(name: str) -> None:
    hospital = services(name)["hospital"]
    assert hospital["profiles"] == ["hospital"]
    assert hospital["command"] == ["hospital"]
    assert hospital["healthcheck"]["test"] == ["CMD", "specimap", "hospital", "--health"]


@pytest.mark.parametrize("name", COMPOSE)
def test_containers_build_the_targets_and_wait_for_what_they_need(name: str) -> None:
    built = services(name)
    for parts in built.values():
        if match := OURS.match(parts["image"]):
            assert parts["build"] == {"context": "..", "dockerfile": "docker/Dockerfile", "target": match[1]}
            assert match[1] in IMAGES
        for needed, how in parts.get("depends_on", {}).items():
            # A container is healthy only if it has a check: of its own, or in our image.
            if how["condition"] == "service_healthy":
                assert "healthcheck" in built[needed] or built[needed]["image"].startswith("specimap-service")


def test_worker_of_one_machine_has_no_network() -> None:
    assert services("compose.yaml")["worker"]["network_mode"] == "none"
    assert services("compose.yaml")["worker"]["volumes"] == services("compose.yaml")["service"]["volumes"]


def test_replicas_share_their_uploads_and_the_proxy_knows_both() -> None:
    built = services("compose.many.yaml")
    assert built["api-1"] == built["api-2"]
    assert built["api-1"]["volumes"] == ["uploads:/data"]
    assert built["proxy"]["environment"]["UPSTREAMS"] == "api-1:8765 api-2:8765"
    assert "volumes" not in built["worker"]

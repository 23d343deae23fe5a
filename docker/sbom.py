"""Lists of packages as CycloneDX 1.6, into out/sbom: of a release, and of an image.

    python docker/sbom.py release                      # python.cdx.json from the lock files, web.cdx.json from npm's
    python docker/sbom.py image specimap-service ROOT  # specimap-service.cdx.json from an image's unpacked root

An image's root is a container's mount, or what `docker export` gives, unpacked. Nothing is fetched.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tomllib
import uuid
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
LONGEST_NAME = 80
"""Longest text of a licence's field that is a name; some packages put the whole licence there."""


def main() -> int:
    """Write what was asked for, and name the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "sbom")
    kinds = parser.add_subparsers(dest="kind", required=True)
    kinds.add_parser("release")
    image = kinds.add_parser("image")
    image.add_argument("name")
    image.add_argument("root", type=Path)
    options = parser.parse_args()
    made = (
        {"python": of_locks(), "web": of_pages()}
        if options.kind == "release"
        else {options.name: of_image(options.name, options.root)}
    )
    options.out.mkdir(parents=True, exist_ok=True)
    for name, bom in made.items():
        target = options.out / f"{name}.cdx.json"
        target.write_text(json.dumps(bom, indent=1, sort_keys=True) + "\n", "utf-8")
        print(f"{target}: {len(bom['components'])} packages")
    return 0


def of_locks() -> dict[str, Any]:
    """All Python packages that an installation may have: of every lock file, with their licences where known."""
    lines = "".join(file.read_text("utf-8") for file in sorted(ROOT.glob("requirements*.lock")))
    pins = sorted({line for line in lines.splitlines() if line[:1] not in ("", "#", "-")})
    tool = [str(BIN / "cyclonedx-py"), "requirements", "--short-PURLs", "--output-reproducible", "--of", "JSON"]
    made = _run([*tool, "--sv", "1.6", "--pyproject", str(ROOT / "pyproject.toml"), "-"], "\n".join(pins) + "\n")
    for component in made["components"]:
        if licences := _licences(component["name"], component["version"]):
            component["licenses"] = licences
    made["metadata"]["component"]["version"] = _version()
    return made


def of_pages() -> dict[str, Any]:
    """All packages of the web pages, those that only build them too."""
    npm = [str(BIN / "npm"), "--prefix", str(ROOT / "web"), "--loglevel", "error"]
    made = _run([*npm, "sbom", "--sbom-format", "cyclonedx", "--package-lock-only"], None)
    # npm writes 1.5, of which 1.6 is an extension.
    return made | {"specVersion": "1.6", "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json"}


def of_image(name: str, root: Path) -> dict[str, Any]:
    """Debian's packages and the Python packages of an image's root."""
    status = (root / "var/lib/dpkg/status").read_text("utf-8")
    release = dict(re.findall(r'^(\w+)="?([^"\n]*)"?$', (root / "etc/os-release").read_text("utf-8"), re.MULTILINE))
    components = []
    for paragraph in status.split("\n\n"):
        fields = dict(re.findall(r"^([\w-]+): (.*)$", paragraph, re.MULTILINE))
        if fields.get("Status", "").endswith(" installed"):
            package, version, machine = fields["Package"], fields["Version"], fields["Architecture"]
            quoted = version.replace("+", "%2B").replace(":", "%3A")
            purl = f"pkg:deb/debian/{package}@{quoted}?arch={machine}&distro=debian-{release.get('VERSION_ID', '')}"
            components.append(_component("library", package, version, purl))
    for folder in sorted(root.glob("opt/specimap/lib/python*/site-packages/*.dist-info")):
        fields = dict(re.findall(r"^(Name|Version): (.*)$", (folder / "METADATA").read_text("utf-8"), re.MULTILINE))
        package, version = fields["Name"].lower().replace("_", "-").replace(".", "-"), fields["Version"]
        purl = f"pkg:pypi/{package}@{version.replace('+', '%2B')}"
        components.append(_component("library", package, version, purl))
        if licences := _licences(package, version):
            components[-1]["licenses"] = licences
    system = _component("operating-system", release.get("ID", "linux"), release.get("VERSION_ID", ""), None)
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        # The same for the same packages.
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(components, sort_keys=True))}",
        "metadata": {"component": _component("container", name, _version(), None)},
        "components": [system, *components],
    }


def _component(kind: str, name: str, version: str, purl: str | None) -> dict[str, Any]:
    made = {"type": kind, "name": name, "version": version, "bom-ref": purl or f"{kind}:{name}"}
    return made | ({"purl": purl} if purl else {})


def _licences(name: str, version: str) -> list[dict[str, Any]]:
    """Licences that an installed package of this version states; none where it is not installed here."""
    try:
        found = metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return []
    if found.version != version:
        return []
    said = {name: found.metadata.get_all(name) or [] for name in ("License-Expression", "License", "Classifier")}
    if said["License-Expression"]:
        return [{"expression": said["License-Expression"][0]}]
    text = "".join(said["License"][:1])
    classified = [line.split(" :: ")[-1] for line in said["Classifier"] if "License ::" in line]
    named = classified or ([text] if 0 < len(text) <= LONGEST_NAME and "\n" not in text else [])
    return [{"license": {"name": each}} for each in sorted(set(named))]


def _version() -> str:
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"])


def _run(command: list[str], given: str | None) -> dict[str, Any]:
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=300)  # noqa: S603 - tools of .venv
    if done.returncode:
        sys.exit(f"{' '.join(command[:2])} failed:\n{done.stderr}")
    made: dict[str, Any] = json.loads(done.stdout)
    return made


if __name__ == "__main__":
    raise SystemExit(main())

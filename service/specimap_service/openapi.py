"""The API's description as a document: ``python -m specimap_service.openapi > openapi.yaml``."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import yaml

from specimap_infra.settings import ServiceSettings
from specimap_service.app import create_app
from specimap_service.context import CONTEXT


def document() -> dict[str, Any]:
    """Return what the app serves at ``/openapi.json``."""
    with tempfile.TemporaryDirectory() as folder:
        app = create_app(ServiceSettings(data_dir=Path(folder), database_url="", storage="", scratch_dir=None))
        try:
            return app.openapi()
        finally:
            CONTEXT.of(app).close()


def as_yaml(contract: dict[str, Any]) -> str:
    """Write the document in YAML, in the order in which the app describes itself."""
    text: str = yaml.safe_dump(contract, sort_keys=False, allow_unicode=True, width=110)
    return text


if __name__ == "__main__":
    sys.stdout.write(as_yaml(document()))

"""Resources against the definitions of FHIR R4, by the npm package ``fhir``."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from tests.support.node import NODE, npm_packages

VALIDATOR = Path(__file__).parent / "validator"


def validated(bundle: dict[str, Any]) -> list[dict[str, Any]]:
    """What the definitions of R4 say against a bundle and its resources."""
    npm_packages(VALIDATOR)
    done = subprocess.run(
        [NODE, "validate.mjs"], cwd=VALIDATOR, input=json.dumps(bundle), capture_output=True, text=True, check=True
    )
    found: list[dict[str, Any]] = json.loads(done.stdout)
    # Value sets that are open: the guide's own codes are in none of them. A code of a closed one is an error.
    return [message for message in found if "not found in value set" not in message["message"] or is_error(message)]


def is_error(message: dict[str, Any]) -> bool:
    return bool(message["severity"] != "warning")

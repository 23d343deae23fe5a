"""Environment variables of child processes."""

from __future__ import annotations

import os
import re
from collections.abc import Collection

SECRETS = re.compile(r"^(SPECIMAP_|AWS_|PG)|SECRET|PASSW|TOKEN|CREDENTIAL|_KEY(_|$)|DATABASE_URL|_DSN$", re.IGNORECASE)
"""Names of variables that may hold keys, or addresses of database and storage."""


def bare_environment(keep: Collection[str] = ()) -> dict[str, str]:
    """The environment without :data:`SECRETS`, but for the variables to ``keep``."""
    return {name: value for name, value in os.environ.items() if name in keep or not SECRETS.search(name)}

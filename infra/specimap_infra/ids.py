"""Identifiers: sortable by time, safe in paths and URLs, without any information about a patient."""

from __future__ import annotations

import re
from typing import Literal

from ulid import ULID

Kind = Literal[
    "acq", "file", "up", "job", "cloud", "key", "exp", "evt", "att", "dlv", "prj", "shr", "dcs", "dci", "person", "ers"
]
PATTERN = re.compile(r"^[a-z]{2,6}_[0-9a-hjkmnp-tv-z]{26}$")


def new_id(kind: Kind) -> str:
    """Make an identifier, ``job_01k…``: a kind and a ULID in lower case."""
    return f"{kind}_{str(ULID()).lower()}"

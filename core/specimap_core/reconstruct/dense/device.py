"""Which device depth is measured on."""

from __future__ import annotations

import os
from collections.abc import Mapping

from specimap_core.errors import SettingsError

DENSE_DEVICE = "SPECIMAP_DENSE_DEVICE"


DEVICES = ("auto", "cpu", "gpu")


def dense_device(environment: Mapping[str, str] = os.environ) -> str:
    """One of :data:`DEVICES`.

    Raises:
        SettingsError: the variable says something else.
    """
    device = environment.get(DENSE_DEVICE, "").strip() or DEVICES[0]
    if device not in DEVICES:
        raise SettingsError(
            f"{DENSE_DEVICE} is {device!r}.", advice=f"It takes one of: {', '.join(DEVICES)}.", setting=DENSE_DEVICE
        )
    return device

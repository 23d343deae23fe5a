"""Which device depth is measured on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, cast, get_args

from specimap_core.errors import SettingsError

DENSE_DEVICE = "SPECIMAP_DENSE_DEVICE"
Device = Literal["auto", "cpu", "gpu"]
DEVICES: tuple[str, ...] = get_args(Device)


def dense_device(environment: Mapping[str, str]) -> Device:
    """The device that the environment names.

    Raises:
        SettingsError: the variable says something else.
    """
    device = environment.get(DENSE_DEVICE, "").strip() or DEVICES[0]
    if device not in DEVICES:
        raise SettingsError(
            f"{DENSE_DEVICE} is {device!r}.", advice=f"It takes one of: {', '.join(DEVICES)}.", setting=DENSE_DEVICE
        )
    return cast(Device, device)

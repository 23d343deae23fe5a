"""``SPECIMAP_DENSE_DEVICE``, which chose a GPU for depth in earlier versions; depth is measured on the CPU.

``auto`` and ``cpu`` are let be where they are still set, and mean the same. The value is in the settings of stage 1,
and so in the keys of its artefacts: those of earlier versions stay in use.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, cast, get_args

from specimap_core.errors import SettingsError

DENSE_DEVICE = "SPECIMAP_DENSE_DEVICE"
Device = Literal["auto", "cpu"]
DEVICES: tuple[str, ...] = get_args(Device)
NO_GPU = "Remove it: depth is measured on the CPU, which is faster than the GPU was (docs/backends.md)."


def dense_device(environment: Mapping[str, str]) -> Device:
    """The value that the environment gives; the default without one.

    Raises:
        SettingsError: the variable asks for a GPU, or says something else.
    """
    device = environment.get(DENSE_DEVICE, "").strip() or DEVICES[0]
    if device not in DEVICES:
        advice = NO_GPU if device == "gpu" else f"Remove it, or set it to one of: {', '.join(DEVICES)}."
        raise SettingsError(f"{DENSE_DEVICE} is {device!r}.", advice=advice, setting=DENSE_DEVICE)
    return cast(Device, device)

"""What the environment says of backends and of the device for dense stereo: all its variables, in one place.

The service's settings and the process of a stage read it, so nothing heavy is imported here.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict

from specimap_core.reconstruct.backends.da3 import settings as da3
from specimap_core.reconstruct.backends.mast3r import settings as mast3r
from specimap_core.reconstruct.backends.weights import Weights
from specimap_core.reconstruct.dense.device import DENSE_DEVICE, dense_device

BACKEND_VARIABLES: dict[str, str] = {
    **{mast3r.PREFIX + name: meaning for name, meaning in mast3r.VARIABLES.items()},
    **{da3.PREFIX + name: meaning for name, meaning in da3.VARIABLES.items()},
    DENSE_DEVICE: "Where the default backend measures depth: auto, cpu or gpu; auto takes a GPU where there is one.",
}
"""Variable, and what it is."""
NOT_IN_IDENTITY = ("cache", "weights")
"""Fields that leave the result as it is: where scratch files lie, and the path of weights whose sha256 counts."""


def check_environment(environment: Mapping[str, str] = os.environ) -> None:
    """Refuse values that cannot be, whichever backend a run will take. Looks at no file.

    Raises:
        SettingsError: details name the variable.
    """
    mast3r.settings_from_environment(environment)
    da3.settings_from_environment(environment)
    dense_device(environment)


def backend_found(
    name: str, environment: Mapping[str, str] = os.environ
) -> tuple[mast3r.Mast3rSettings | da3.Da3Settings, Weights] | None:
    """Settings and weights of a backend with a network; None for others.

    Raises:
        SettingsError: a variable's value cannot be.
        BackendUnavailableError: its code or its weights are not there, or not the pinned ones.
    """
    if name == mast3r.NAME:
        chosen = mast3r.settings_from_environment(environment)
        mast3r.check_home(chosen.home)
        return chosen, mast3r.weights_of(chosen)
    if name == da3.NAME:
        own = da3.settings_from_environment(environment)
        own.code_path()
        return own, own.find_weights()
    return None


def backend_identity(name: str, environment: Mapping[str, str] = os.environ) -> dict[str, object] | None:
    """What a result of the backend depends on besides a run's own settings: its variables, and the weights' sha256.

    None for a backend that has neither. Raises as :func:`backend_found` does.
    """
    found = backend_found(name, environment)
    if found is None:
        return None
    chosen, weights = found
    settings = {field: value for field, value in asdict(chosen).items() if field not in NOT_IN_IDENTITY}
    return {"settings": settings, "weights": weights.sha256}

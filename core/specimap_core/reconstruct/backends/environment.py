"""What the environment says of backends: all its variables, in one place.

A program reads it once, when it starts, and passes the answer on. Nothing heavy is imported, so that the service can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

from specimap_core.reconstruct.backends.da3 import settings as da3
from specimap_core.reconstruct.backends.da3.settings import Da3Settings
from specimap_core.reconstruct.backends.mast3r import settings as mast3r
from specimap_core.reconstruct.backends.mast3r.settings import Mast3rSettings
from specimap_core.reconstruct.backends.weights import Weights, hash_cache_in
from specimap_core.reconstruct.dense.device import DENSE_DEVICE, Device, dense_device

BACKEND_VARIABLES: dict[str, str] = {
    **{mast3r.PREFIX + name: meaning for name, meaning in mast3r.VARIABLES.items()},
    **{da3.PREFIX + name: meaning for name, meaning in da3.VARIABLES.items()},
    DENSE_DEVICE: "Obsolete: auto and cpu give the same result, and gpu is refused. Depth is measured on the CPU.",
}
"""Variable, and what it is."""
NOT_IN_IDENTITY = ("cache", "hash_cache", "weights")
"""Fields that leave the result as it is: folders for scratch files and hashes, and the path of weights whose sha256
counts."""


@dataclass(frozen=True)
class BackendSettings:
    """Settings of the backends with a network, and the ``device`` that the default backend's keys hold."""

    mast3r: Mast3rSettings = field(default_factory=Mast3rSettings)
    da3: Da3Settings = field(default_factory=Da3Settings)
    device: Device = "auto"


UNCONFIGURED = BackendSettings()
"""With no network's code or weights named."""


def backends_from(environment: Mapping[str, str], chosen: str | None = None) -> BackendSettings:
    """The settings as the variables say; looks at no file.

    ``chosen``: the backend that a run takes. Variables of other backends are not read then, so that a wrong one does
    not stop the run; by default all are.

    Raises:
        SettingsError: a value cannot be; details name the variable.
    """
    found = BackendSettings(device=dense_device(environment))
    if chosen in (None, mast3r.NAME):
        found = replace(found, mast3r=mast3r_from(environment))
    if chosen in (None, da3.NAME):
        found = replace(found, da3=da3_from(environment))
    return found


def mast3r_from(environment: Mapping[str, str]) -> Mast3rSettings:
    """MASt3R's settings, with the user's cache; raises as :func:`backends_from` does."""
    return replace(mast3r.settings_from_environment(environment), hash_cache=hash_cache_in(environment))


def da3_from(environment: Mapping[str, str]) -> Da3Settings:
    """The same of Depth Anything 3."""
    return replace(da3.settings_from_environment(environment), hash_cache=hash_cache_in(environment))


def backend_found(name: str, backends: BackendSettings) -> tuple[Mast3rSettings | Da3Settings, Weights] | None:
    """Settings and weights of a backend with a network; None for others.

    Raises:
        BackendUnavailableError: its code or its weights are not there, or not the pinned ones.
    """
    if name == mast3r.NAME:
        mast3r.check_home(backends.mast3r.home)
        return backends.mast3r, mast3r.weights_of(backends.mast3r)
    if name == da3.NAME:
        backends.da3.code_path()
        return backends.da3, backends.da3.find_weights()
    return None


def backend_identity(name: str, backends: BackendSettings) -> dict[str, object] | None:
    """What a result of the backend depends on apart from a run's own settings: its variables, and the weights' sha256.

    None for a backend that has neither. Raises as :func:`backend_found` does.
    """
    found = backend_found(name, backends)
    if found is None:
        return None
    chosen, weights = found
    settings = {field: value for field, value in asdict(chosen).items() if field not in NOT_IN_IDENTITY}
    return {"settings": settings, "weights": weights.sha256}

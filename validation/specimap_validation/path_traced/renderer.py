"""Mitsuba, which traces the light: checked and set up before any other module here uses it."""

from __future__ import annotations

from importlib.util import find_spec

from specimap_core.errors import BackendUnavailableError

VARIANT = "llvm_ad_rgb"
LEAST_LLVM = 19
"""LLVM 15 and 16 end the process at the first kernel, for want of an instruction; 19 and 22 were tried."""


def start_renderer() -> None:
    """Load Mitsuba and choose its variant. Raises ``BackendUnavailableError`` where it, or its LLVM, is not there."""
    missing = renderer_missing()
    if missing:
        raise BackendUnavailableError(
            f"Path-traced phantoms need {missing}.",
            advice="Install them: make path-traced, apt install libllvm19; DRJIT_LIBLLVM_PATH names another LLVM.",
            missing=[missing],
        )
    import mitsuba as mi

    mi.set_variant(VARIANT)


def renderer_missing() -> str:
    """What path tracing needs and this machine lacks, in words; empty where nothing is missing."""
    if find_spec("mitsuba") is None:
        return "Mitsuba, which is not installed"
    import drjit

    if not drjit.has_backend(drjit.JitBackend.LLVM):
        return f"LLVM {LEAST_LLVM} or later, which was not found"
    version = drjit.detail.llvm_version()
    if version[0] < LEAST_LLVM:
        return f"LLVM {LEAST_LLVM} or later, and found {'.'.join(map(str, version))}"
    return ""

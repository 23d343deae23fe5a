"""Check at the start that processes which read uploaded files are confined."""

from __future__ import annotations

from specimap_core.errors import SettingsError
from specimap_core.sandbox import protection
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings


def check_confinement(settings: ServiceSettings) -> None:
    """Warn if such processes could reach more than their files.

    Raises:
        SettingsError: they could, and the settings require that they cannot.
    """
    found = protection()
    if settings.sandbox == "off":
        logger().warning("uploaded files are read without confinement: SPECIMAP_SANDBOX is off")
    elif not found.whole and settings.sandbox == "require":
        raise SettingsError(
            f"SPECIMAP_SANDBOX is require, and this kernel, or the container's profile, offers no {found.missing}.",
            advice="Use Linux 5.19 or later with Landlock, on x86-64 or AArch64, or set it to best-effort.",
            setting="sandbox",
        )
    elif not found.whole:
        logger().warning(
            f"what reads uploaded files is not wholly confined: the kernel or the container offers no {found.missing}",
            landlock=found.landlock,
            seccomp=found.seccomp,
        )

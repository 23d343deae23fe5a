"""Native libraries that need a hand before they import."""

from __future__ import annotations

import ctypes
import importlib
import sys
import threading
from contextlib import suppress
from types import ModuleType

from specimap_core.errors import BackendUnavailableError

ATTEMPTS = 10
"""At importing Open3D while other threads import."""


def open3d() -> ModuleType:
    """Open3D, with the system library libusb brought by the package ``libusb-package`` where it is absent.

    Raises:
        BackendUnavailableError: it cannot be loaded; the advice names the one command that mends it.
    """
    if sys.platform == "linux":
        try:
            ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
        except OSError:
            try:
                package = importlib.import_module("libusb_package")
                ctypes.CDLL(str(package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
            except (ImportError, OSError) as error:
                raise BackendUnavailableError(
                    f"Open3D needs the system library libusb-1.0, which is absent ({error}).",
                    advice="Install it: sudo apt-get install libusb-1.0-0",
                ) from error
    try:
        return _import_open3d()
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendUnavailableError(
            f"Open3D does not load: {error}.",
            advice="Install the system libraries it wants: "
            "sudo apt-get install libusb-1.0-0 libgomp1 libgl1 libegl1 libx11-6 libidn2-0",
        ) from error


def quiet_colmap() -> None:
    """Keep COLMAP's notes off standard error in this process: it reports every extractor it makes, and every step."""
    pycolmap = importlib.import_module("pycolmap")
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING


def _import_open3d() -> ModuleType:
    for _ in range(ATTEMPTS - 1):
        # Its import loops over sys.modules, and fails where another thread imports a module meanwhile. What it has
        # loaded stays: a repeat takes milliseconds.
        with suppress(RuntimeError):
            return importlib.import_module("open3d")
    return importlib.import_module("open3d")


def preload() -> None:
    """Load Open3D in the background: its second of importing hides behind other work; errors come when it is used."""

    def load() -> None:
        with suppress(BackendUnavailableError):
            open3d()

    threading.Thread(target=load, daemon=True).start()

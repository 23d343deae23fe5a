"""The backend's own script for the child's process, with the stand-in for torchvision where that is missing."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.mast3r_torchvision import stand_in


def run(request: dict[str, Any], arrays: dict[str, Any], step: Any) -> Any:
    """As :func:`specimap_core.reconstruct.backends.mast3r.child.run`."""
    from specimap_core.reconstruct.backends.mast3r import child

    stand_in()
    return child.run(request, arrays, step)

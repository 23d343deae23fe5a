"""The real drawing, which waits while the service's data folder has a file ``hold``; pictures of 999 pixels do not."""

from __future__ import annotations

import time

from specimap_infra.settings import ServiceSettings
from specimap_service.clouds import drawing
from specimap_service.clouds.drawing import Drawing
from specimap_service.clouds.pictures import Picture


def draw(settings: ServiceSettings, wanted: Drawing) -> Picture:
    """Draw, once it may."""
    while wanted.size != 999 and (settings.data_dir / "hold").exists():
        time.sleep(0.02)
    return drawing.draw(settings, wanted)

"""``python -m tests.support.outbox_sender SECONDS OBJECTS``: a sender in a process of its own, with small objects.

It takes its settings from the environment; its clock goes SECONDS ahead. It ends when nothing waits.
"""

from __future__ import annotations

import datetime
import sys
from functools import partial

from specimap_hospital.outbox.sender import Sender
from specimap_infra.database import Database, utc_now
from specimap_infra.logs import set_up_logs
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from tests.support.outbox_scene import small_objects


def main(ahead: float, objects: int) -> None:
    """Send."""
    settings = load_settings()
    set_up_logs(settings)
    sender = Sender(
        Database.open(settings.database),
        Storage.open(settings),
        settings,
        make=partial(small_objects, count=objects),
        clock=lambda: utc_now() + datetime.timedelta(seconds=ahead),
    )
    while sender.work():
        print("sent", flush=True)


if __name__ == "__main__":
    main(float(sys.argv[1]), int(sys.argv[2]))

"""Two hundred results while the archive is away for an hour: all arrive, each once, also where the sender is killed."""

from __future__ import annotations

import datetime
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_hospital.outbox.sender import Sender
from specimap_infra.database import Database, utc_now
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.tables import DicomInstance, DicomSet
from tests.support.databases import create_tables
from tests.support.hospital_scene import KEY
from tests.support.orthanc import RunningOrthanc
from tests.support.outbox_scene import Clock, add_cloud, small_objects, with_settings
from tests.support.places import ROOT

RESULTS, OBJECTS = 200, 2
OUTAGE_SECONDS = 3600.0
AHEAD_SECONDS = 2 * OUTAGE_SECONDS


def started(settings: ServiceSettings, ahead: float) -> subprocess.Popen[str]:
    given = {
        "DATA_DIR": str(settings.data_dir),
        "DATABASE_URL": settings.database_url,
        "LOG_LEVEL": "error",
        "STUDY_KEYS": f'["{KEY}"]',
        "PACS_URL": settings.pacs_url,
        "PACS_USER": settings.pacs_user,
        "PACS_PASSWORD": settings.pacs_password.get_secret_value(),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "tests.support.outbox_sender", str(ahead), str(OBJECTS)],
        env={**os.environ, **{f"SPECIMAP_{name}": value for name, value in given.items()}},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )


def counts(database: Database) -> Counter[str]:
    with database.session() as session:
        return Counter(session.scalars(sa.select(DicomSet.state)))


def arrivals(archive: RunningOrthanc) -> Counter[str]:
    """How often the archive has taken each object."""
    found: Counter[str] = Counter()
    since, done = 0, False
    while not done:
        page = archive.get(f"/changes?since={since}&limit=1000")
        found.update(change["ID"] for change in page["Changes"] if change["ChangeType"] == "NewInstance")
        since, done = page["Last"], page["Done"]
    return found


@pytest.mark.slow
@pytest.mark.waits
def test_nothing_is_lost_or_doubled(archive: RunningOrthanc, any_database: str, tmp_path: Path) -> None:
    settings = with_settings(
        None, data_dir=tmp_path, database_url=any_database, study_keys=[KEY], pacs_url="http://127.0.0.1:9/dicom-web"
    )
    database = Database.open(settings.database)
    create_tables(database)
    for _ in range(RESULTS):
        add_cloud(database, settings)
    before = sum(arrivals(archive).values())

    # The archive is away for an hour.
    clock = Clock()
    sender = Sender(database, Storage.open(settings), settings, make=small_objects, clock=clock)
    assert [sender.add(), sender.add(), sender.add()] == [100, 100, 0]
    start, attempts = clock(), 0
    while clock() < start + datetime.timedelta(seconds=OUTAGE_SECONDS):
        while sender.work():
            attempts += 1
        with database.session() as session:
            clock.now = session.scalars(sa.select(sa.func.min(DicomSet.next_at))).one()
    assert counts(database) == {"waiting": RESULTS}
    assert attempts <= 12 * RESULTS, "attempts grow rare"

    # It is back; the sender is killed in the middle.
    settings = with_settings(
        settings, pacs_url=archive.dicomweb_url, pacs_user=archive.user, pacs_password=archive.password
    )
    with started(settings, AHEAD_SECONDS) as first:
        assert first.stdout is not None
        for _ in range(30):
            assert first.stdout.readline() == "sent\n"
        first.send_signal(signal.SIGKILL)
    done = counts(database)["sent"]
    assert 30 <= done < RESULTS
    # Two go on together, once the claim of the killed one has run out.
    others = [started(settings, AHEAD_SECONDS + 3600) for _ in range(2)]
    for other in others:
        output, _ = other.communicate(timeout=300)
        assert other.returncode == 0
        assert output.count("sent") > 10, "they share the work"
    assert counts(database) == {"sent": RESULTS}
    with database.session() as session:
        assert Counter(session.scalars(sa.select(DicomInstance.state))) == {"sent": RESULTS * OBJECTS}
        uids = set(session.scalars(sa.select(DicomInstance.sop_instance_uid)))
    database.close()
    time.sleep(0.5)
    assert uids <= archive.instances()
    assert sum(arrivals(archive).values()) - before == RESULTS * OBJECTS
    assert set(arrivals(archive).values()) == {1}
    assert utc_now() > start

"""Sends sets of DICOM objects to the archive, one after the other; several senders share them.

What a sender does is safe to end anywhere. It notes that an object is about to be sent before it sends it, so whoever
goes on asks the archive for that one first: none is lost, and none is sent without need.
"""

from __future__ import annotations

import datetime
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from specimap_core.errors import CancelledError, SpecimapError, StorageFullError
from specimap_hospital.connections import PeerError
from specimap_hospital.dicom.model import DicomObject
from specimap_hospital.outbox.archive import Archive, open_archive
from specimap_hospital.outbox.commitment import ask_for_commitment
from specimap_hospital.outbox.instances import ClaimLostError, Known, begin, counted, settle, take_stock
from specimap_hospital.outbox.making import make_objects
from specimap_hospital.outbox.rows import Claim, add_wanted, claim, finish, renew
from specimap_hospital.outbox.trail import note_end
from specimap_hospital.outbox.workspaces import workspace
from specimap_infra.claims import wait_seconds
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import (
    DatabaseUnavailableError,
    StageTimeoutError,
    StorageUnavailableError,
    StudyKeysMissingError,
    StudySealedError,
    WorkerCrashedError,
)
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage

LEAST_LEASE_SECONDS = 120.0
LEASES = 3
"""How many of the longest sendings of one object a lease lasts."""
PASSING = (StorageUnavailableError, StorageFullError, StudyKeysMissingError, StudySealedError)
"""What keeps a set from being made until somebody, or time, has mended it."""
TRIED_AGAIN = (WorkerCrashedError, StageTimeoutError)
"""What may be the set's own fault: tried a few times."""
MOST_CRASHES = 5
FIRST_WAIT_SECONDS = 5.0

Make = Callable[[Claim, Path, Callable[[], bool]], list[DicomObject]]


class Sender:
    """One sender. ``clock``: the time that rows are written with and compared to."""

    def __init__(
        self,
        database: Database,
        storage: Storage,
        settings: ServiceSettings,
        *,
        make: Make | None = None,
        clock: Callable[[], datetime.datetime] = utc_now,
    ) -> None:
        """``make``: makes the objects of a set in a folder, by default :func:`make_objects`."""
        self._database, self._storage, self._settings = database, storage, settings
        self._make = make or self._made
        self._clock = clock
        self._name = uuid.uuid4().hex
        self._lease = max(LEAST_LEASE_SECONDS, LEASES * settings.pacs_seconds)
        self._stop = threading.Event()

    def stop(self) -> None:
        """Stop after the object that is being sent; what is left is given back."""
        self._stop.set()

    def add(self) -> int:
        """Add what is to be sent. Raises DatabaseUnavailableError."""
        return add_wanted(self._database, self._clock(), automatic=self._settings.pacs_send == "all")

    def work(self) -> bool:
        """Do one set that is due; False where none is. Raises DatabaseUnavailableError."""
        states = ("waiting", "sent") if self._settings.pacs_commitment == "on" else ("waiting",)
        held = claim(self._database, self._name, self._clock(), self._span(self._lease), states)
        if held is None:
            return False
        try:
            with _Hold(self, held) as hold:
                if held.state == "sent":
                    self._commit(held)
                else:
                    self._send(held, hold)
        except ClaimLostError:
            logger().info("dicom set changed meanwhile", set=held.set_id)
            finish(self._database, held, self._clock())
        return True

    # ---- a set ----------------------------------------------------------------------------------------

    def _send(self, held: Claim, hold: _Hold) -> None:
        """Send a set's objects that wait, and write how it ended."""
        try:
            with ExitStack() as stack:
                # Asked before the objects are made, which takes longer.
                archive = open_archive(self._settings, stack)
                folder = stack.enter_context(workspace(self._settings.scratch))
                objects = self._make(held, folder, lambda: self._stop.is_set() or hold.lost)
                known = take_stock(self._database, held, objects)
                for made in objects:
                    if known[made.sop_instance_uid].state == "waiting":
                        hold.check()
                        self._send_one(held, archive, made, known[made.sop_instance_uid])
        except PeerError as error:
            self._later(held, error.reason)
        except CancelledError:
            self._later(held, held.reason, now=True)
        except PASSING as error:
            self._later(held, error.code)
        except DatabaseUnavailableError:
            raise
        except SpecimapError as error:
            if isinstance(error, TRIED_AGAIN) and held.attempt < MOST_CRASHES:
                self._later(held, error.code)
            else:
                self._end(held, "failed", error.code)
        else:
            counts = counted(self._database, held.set_id)
            if counts.get("waiting"):
                self._later(held, "not_taken")
            else:
                failed = "failed" in counts
                self._end(held, "failed" if failed else "sent", "refused" if failed else None)

    def _send_one(self, held: Claim, archive: Archive, made: DicomObject, known: Known) -> None:
        """Send an object, and note how that ended. Raises PeerError where the archive cannot be asked any more."""
        if known.attempts and self._is_there(archive, made):
            settle(self._database, held, known.id, "sent", self._clock())
            return
        begin(self._database, held, known.id)
        try:
            archive.send(made)
        except PeerError as error:
            if self._is_there(archive, made):
                settle(self._database, held, known.id, "sent", self._clock())
                return
            settle(
                self._database, held, known.id, "waiting" if error.passing else "failed", self._clock(), error.reason
            )
            if error.away:
                raise
        else:
            settle(self._database, held, known.id, "sent", self._clock())

    def _is_there(self, archive: Archive, made: DicomObject) -> bool:
        try:
            return archive.has(made)
        except PeerError:
            # It does not say: sent again, it has the same name, and takes the place of the first.
            return False

    def _made(self, held: Claim, folder: Path, cancelled: Callable[[], bool]) -> list[DicomObject]:
        return make_objects(
            self._database,
            self._storage,
            self._settings,
            held.cloud_id,
            held.options,
            folder,
            cancelled=cancelled,
        )

    def _commit(self, held: Claim) -> None:
        """Ask the archive to commit itself to a set that was sent."""
        ask_for_commitment(self._database, self._settings, held, self._clock)

    # ---- how it ended ---------------------------------------------------------------------------------

    def _later(self, held: Claim, reason: str | None, *, now: bool = False) -> None:
        if held.attempt >= self._settings.pacs_attempts and not now:
            self._end(held, "failed", reason)
            return
        wait = 0.0 if now else wait_seconds(held.attempt, FIRST_WAIT_SECONDS, self._settings.pacs_longest_wait_seconds)
        at = self._clock()
        # An attempt that was broken off from here is none.
        counted = {"attempts": held.attempt - 1} if now else {}
        finish(self._database, held, at, next_at=at + self._span(wait), reason=reason, **counted)
        # An archive that is away for a day would fill the log.
        log = logger().warning if held.attempt == 1 else logger().debug
        log("dicom set waits", set=held.set_id, attempt=held.attempt, reason=reason, seconds=wait)

    def _end(self, held: Claim, state: str, reason: str | None) -> None:
        at = self._clock()
        # Attempts to have it committed are counted anew.
        values = {"state": state, "reason": reason, "attempts": 0, "next_at": at, "settled_at": at}
        if finish(self._database, held, at, **values):
            note_end(self._database, held, state, reason)
            log = logger().info if state == "sent" else logger().error
            log("dicom set ended", set=held.set_id, state=state, attempt=held.attempt, reason=reason)

    def _span(self, seconds: float) -> datetime.timedelta:
        return datetime.timedelta(seconds=seconds)


class _Hold:
    """Renews a claim in a thread for the time of a block."""

    def __init__(self, sender: Sender, held: Claim) -> None:
        self._sender, self._held = sender, held
        self._lease = sender._lease
        self._renewed = time.monotonic()
        self.lost = False
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="dicom claim", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(timeout=5)

    def check(self) -> None:
        """Raise unless the claim lasts long enough for one more object, and the sender goes on.

        Raises:
            ClaimLostError, CancelledError.
        """
        if self._sender._stop.is_set():
            raise CancelledError("The sender was stopped.", advice="The next one goes on.")
        left = self._lease - (time.monotonic() - self._renewed)
        if self.lost or left < self._sender._settings.pacs_seconds:
            raise ClaimLostError

    def _run(self) -> None:
        while not self._end.wait(self._lease / 6):
            started = time.monotonic()
            try:
                until = self._sender._clock() + self._sender._span(self._lease)
                self.lost = self.lost or not renew(self._sender._database, self._held, until)
                self._renewed = started
            except DatabaseUnavailableError:
                pass  # the log tells once that it is away

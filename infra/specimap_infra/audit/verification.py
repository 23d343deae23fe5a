"""Verification of the audit trail: finds records that were changed, removed or put in another order."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import SettingsError
from specimap_infra.audit.pruning import ACTION
from specimap_infra.audit.records import FIELDS, ChainKeys, canonical
from specimap_infra.audit.sealing import HEAD
from specimap_infra.database import Database
from specimap_infra.tables import AuditEntry, AuditHead

BATCH = 1000
Kind = Literal["changed", "missing", "reordered", "unknown_key"]


@dataclass(frozen=True)
class Fault:
    """The first record that is not as it was written."""

    kind: Kind
    seq: int
    what: str


@dataclass(frozen=True)
class Anchor:
    """A place in the chain and its hash, kept elsewhere; as text ``SEQ:HASH``."""

    seq: int
    hash: str

    @classmethod
    def parsed(cls, text: str) -> Anchor:
        """Read what `specimap audit head` printed. Raises SettingsError."""
        found = re.fullmatch(r"(\d{1,18}):((?:sha256|hmac-sha256:[0-9a-f]{12}):[0-9a-f]{64}|0{64})", text.strip())
        if found is None:
            raise SettingsError(
                "The anchor does not read.",
                advice="Give what `specimap audit head` printed, SEQ:HASH.",
                setting="anchor",
            )
        return cls(int(found[1]), found[2])

    def __str__(self) -> str:
        return f"{self.seq}:{self.hash}"


@dataclass(frozen=True)
class Verified:
    """What a verification found. ``first``, ``last``: places of the records there are; ``unsealed``: entries that wait
    for the sealer; ``anchored``: whether the anchor, if one was given, lies in what is left of the chain."""

    records: int
    first: int
    last: int
    head: Anchor
    unsealed: int
    anchored: bool | None
    fault: Fault | None


def chain_head(session: Session) -> Anchor:
    """Return the newest sealed place."""
    head = session.get_one(AuditHead, HEAD)
    return Anchor(head.seq, head.hash)


def verify(
    database: Database,
    keys: ChainKeys,
    anchor: Anchor | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Verified:
    """Recompute the chain from its beginning, or from the checkpoint that retention left.

    Raises:
        DatabaseUnavailableError: the server cannot be reached.
    """
    while True:
        found, pruned = _verified(database, keys, anchor, progress)
        with database.session() as session:
            # Housekeeping may have removed the beginning meanwhile.
            if found.fault is None or session.get_one(AuditHead, HEAD).pruned_seq == pruned:
                return found


def _verified(
    database: Database, keys: ChainKeys, anchor: Anchor | None, progress: Callable[[float], None]
) -> tuple[Verified, int]:
    with database.session() as session:
        head = session.get_one(AuditHead, HEAD)
        # The head is read before the records: what is sealed meanwhile lies beyond it and is left for the next time.
        unsealed = session.scalar(sa.select(sa.func.count()).where(AuditEntry.seq.is_(None))) or 0
        walk = _Walk(session, keys, head, anchor)
        fault = walk.run(progress) or _checkpoint_fault(session, head) or walk.end()
        newest = Anchor(head.seq, head.hash)
        found = Verified(walk.count, head.pruned_seq + 1, walk.seq, newest, unsealed, walk.anchored, fault)
        return found, head.pruned_seq


class _Walk:
    def __init__(self, session: Session, keys: ChainKeys, head: AuditHead, anchor: Anchor | None) -> None:
        self._session, self._keys, self._head, self._anchor = session, keys, head, anchor
        self.seq, self._previous, self.count = head.pruned_seq, head.pruned_hash, 0
        self._keyed = False
        self.anchored: bool | None = None if anchor is None else False

    def run(self, progress: Callable[[float], None]) -> Fault | None:
        if self._anchor is not None and self._anchor.seq == self.seq:
            self.anchored = True
            if self._anchor.hash != self._previous:
                return Fault("changed", self.seq, "the chain begins with another hash than the anchor's")
        table = AuditEntry.__table__
        names = [*FIELDS, "seq", "previous_hash", "hash"]
        query = (
            sa.select(*(table.c[name] for name in names))
            .where(table.c.seq > self.seq, table.c.seq <= self._head.seq)
            .order_by(table.c.seq)
            .execution_options(yield_per=BATCH)
        )
        total = max(1, self._head.seq - self._head.pruned_seq)
        with self._session.execute(query) as rows:
            for row in map(dict, rows.mappings()):
                if (fault := self._step(row)) is not None:
                    return fault
                if self.count % BATCH == 0:
                    progress(self.count / total)
        return None

    def _step(self, row: dict[str, Any]) -> Fault | None:
        seq, expected = int(row["seq"]), self.seq + 1
        if row["previous_hash"] != self._previous:
            after = sa.select(AuditEntry.seq).where(
                AuditEntry.previous_hash == self._previous, AuditEntry.seq > expected
            )
            elsewhere = self._session.scalar(after.limit(1))
            if elsewhere is not None:
                return Fault("reordered", expected, f"the record that follows {self.seq} stands at {elsewhere}")
            own = str(row["previous_hash"])
            if seq == expected and self._keys.explains(canonical(row, seq, own), str(row["hash"])):
                return Fault("changed", self.seq, f"record {seq} follows another hash than its own")
            return Fault("missing", expected, f"the record that followed {self.seq} is gone")
        if seq != expected:
            return Fault("missing", expected, f"after {self.seq} comes {seq}")
        found = str(row["hash"])
        if not self._keys.knows(found):
            return Fault("unknown_key", seq, "the record was sealed with a key that is not at hand")
        if not self._keys.explains(canonical(row, seq, self._previous), found):
            return Fault("changed", seq, "the record is not what its hash is over")
        if self._keyed and found.startswith("sha256:"):
            return Fault("changed", seq, "a record without a key follows one with a key")
        self._keyed = self._keyed or found.startswith("hmac")
        self.seq, self._previous = seq, found
        self.count += 1
        if self._anchor is not None and self._anchor.seq == seq:
            self.anchored = True
            if self._anchor.hash != found:
                return Fault("changed", seq, "the record has another hash than the anchor's")
        return None

    def end(self) -> Fault | None:
        if self.seq < self._head.seq:
            return Fault("missing", self.seq + 1, f"the newest records up to {self._head.seq} are gone")
        if self._previous != self._head.hash:
            return Fault("changed", self.seq, "the newest record has another hash than the head of the chain")
        if self._anchor is not None and self._anchor.seq > self.seq:
            return Fault("missing", self.seq + 1, f"the anchor names record {self._anchor.seq}")
        if self._keys.current is not None and self.count and not self._keyed:
            return Fault("changed", self.seq, "no record was sealed with the key")
        return None


def _checkpoint_fault(session: Session, head: AuditHead) -> Fault | None:
    """Compare the beginning of the chain with what the trail itself says about the newest removal."""
    entries = session.scalars(
        sa.select(AuditEntry).where(AuditEntry.action == ACTION).order_by(AuditEntry.id.desc()).limit(1)
    ).all()
    told = entries[0].details if entries else {"through": 0}
    if told["through"] != head.pruned_seq or (head.pruned_seq and told["hash"] != head.pruned_hash):
        return Fault("missing", head.pruned_seq, "the chain begins elsewhere than the newest removal says")
    return None

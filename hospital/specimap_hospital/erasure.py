"""Erasure of a specimen: everything of it goes, and a signed certificate says so.

The certificate names the specimen by a keyed hash only. A list of erasures outside of the database lets a restore of an
older backup erase them again.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from dbos import DBOSClient
from sqlalchemy.orm import Session

from specimap_core import __version__
from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError, SettingsError
from specimap_core.json_text import json_text
from specimap_infra.audit.entries import new_entry
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import seal
from specimap_infra.database import Database, utc_now
from specimap_infra.deletion import Removal, check_removable, leftovers, remove_rest, remove_rows, stored_files
from specimap_infra.ids import new_id
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import TEMPORARY, Storage
from specimap_infra.tables import Acquisition, AuditEntry, Base, Erasure, LegalHold

LIST = "erasures.jsonl"
KEY = "signing-key.pem"
CHECKPOINTS = 20
"""Tries at emptying SQLite's journal while others read."""


@dataclass(frozen=True)
class Signer:
    """The Ed25519 key that signs certificates, and keys the hashes of specimens."""

    key: Ed25519PrivateKey

    @classmethod
    def of(cls, settings: ServiceSettings) -> Signer:
        """Read the key, or make it where the settings name none and there is none yet.

        Raises:
            SettingsError: it does not read.
            OutputNotWritableError, StorageFullError: it cannot be made.
        """
        path = settings.signing_key or settings.data_dir / KEY
        if settings.signing_key is None and not path.exists():
            made = Ed25519PrivateKey.generate().private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
            with disk_errors(path):
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
                with open(os.open(aside, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o600), "wb") as file:
                    file.write(made)
                    file.flush()
                    os.fsync(file.fileno())
                try:
                    # Not a rename: of two that make one at the same time, both use the first one's.
                    os.link(aside, path)
                except FileExistsError:
                    pass
                finally:
                    aside.unlink()
        try:
            key = serialization.load_pem_private_key(path.read_bytes(), None)
        except (OSError, ValueError, TypeError) as error:
            raise _unreadable(path) from error
        if not isinstance(key, Ed25519PrivateKey):
            raise _unreadable(path)
        return cls(key)

    def hash_of(self, specimen_id: str) -> str:
        """Return the keyed hash of a specimen's id."""
        raw = self.key.private_bytes_raw()
        return hmac.new(raw, f"specimen\0{specimen_id}".encode(), hashlib.sha256).hexdigest()

    def signed(self, facts: dict[str, Any]) -> dict[str, Any]:
        """Return a certificate with the hash of its facts, the public key and the signature."""
        text = _canonical(facts)
        public = self.key.public_key().public_bytes_raw()
        return {
            **facts,
            "sha256": hashlib.sha256(text).hexdigest(),
            "public_key": base64.b64encode(public).decode(),
            "signature": base64.b64encode(self.key.sign(text)).decode(),
        }


def is_genuine(certificate: dict[str, Any], public_key: str) -> bool:
    """Return whether a certificate is as it was signed, with the key whose public half (base64) is given."""
    added = ("sha256", "public_key", "signature")
    facts = {name: value for name, value in certificate.items() if name not in added}
    try:
        key = Ed25519PublicKey.from_public_bytes(base64.b64decode(public_key))
        key.verify(base64.b64decode(certificate["signature"]), _canonical(facts))
    except (InvalidSignature, ValueError, KeyError):
        return False
    return hmac.compare_digest(hashlib.sha256(_canonical(facts)).hexdigest(), str(certificate["sha256"]))


def _canonical(facts: dict[str, Any]) -> bytes:
    return json_text(facts, sort_keys=True, separators=(",", ":")).encode()


def _unreadable(path: Path) -> SettingsError:
    return SettingsError(
        f"{path} is no Ed25519 key in PEM.",
        advice="Name another in SPECIMAP_SIGNING_KEY; `openssl genpkey -algorithm ed25519` makes one.",
        setting="signing_key",
    )


class Eraser:
    """Erases specimens. Safe to be stopped anywhere: the same call goes on."""

    def __init__(self, database: Database, storage: Storage, settings: ServiceSettings, queue: DBOSClient) -> None:
        self._database = database
        self._storage = storage
        self._settings = settings
        self._queue = queue
        self._signer = Signer.of(settings)

    def erase(self, specimen_id: str, actor: str, correlation_id: str = "") -> Erasure:
        """Erase all acquisitions of a specimen, and return the erasure with its certificate.

        Raises:
            NotFoundError: there is none, and no erasure of it was stopped.
            LegalHoldError, JobConflictError: one may not be deleted, or a job works on it; nothing is erased then.
            StorageUnavailableError, DatabaseUnavailableError: the erasure has begun; the same call ends it.
        """
        digest = self._signer.hash_of(specimen_id)
        with self._database.session() as session:
            found = list(session.scalars(sa.select(Acquisition.id).where(Acquisition.specimen_id == specimen_id)))
            begun = session.scalars(
                sa.select(Erasure).where(Erasure.specimen_hash == digest, Erasure.state == "running")
            ).all()
            if not found and not begun:
                raise NotFoundError(
                    "There is no acquisition of the specimen.", advice="Check the id; it may have been erased before."
                )
        erasures = [row.id for row in begun]
        if found:
            erasures.append(self._begin(found, digest, actor, correlation_id, held=False))
        return [self._finish(erasure_id) for erasure_id in erasures][-1]

    def again(self, erased: list[dict[str, Any]], actor: str) -> list[Erasure]:
        """Erase what a restored backup has brought back, by the list of erasures; a hold that it brought back, too."""
        acquisitions = {name for entry in erased for name in entry["acquisitions"]}
        hashes = {entry["specimen_hash"] for entry in erased}
        with self._database.session() as session:
            rows = session.execute(sa.select(Acquisition.id, Acquisition.specimen_id)).all()
        back: dict[str, list[str]] = {}
        for row in rows:
            digest = self._signer.hash_of(row.specimen_id)
            if row.id in acquisitions or digest in hashes:
                back.setdefault(digest, []).append(row.id)
        return [self._finish(self._begin(names, digest, actor, "", held=True)) for digest, names in back.items()]

    def _begin(self, found: list[str], digest: str, actor: str, correlation_id: str, *, held: bool) -> str:
        with self._database.session() as session:
            # A write that changes nothing, since SQLite locks by writes only.
            locked = sa.update(Acquisition).where(Acquisition.id.in_(found)).values(notes=Acquisition.notes)
            session.execute(locked, execution_options={"synchronize_session": False})
            row = Erasure(
                id=new_id("ers"),
                specimen_hash=digest,
                acquisitions=found,
                removal={},
                state="running",
                created_by=actor,
                created_at=utc_now(),
            )
            for acquisition in found:
                if held:
                    session.execute(sa.delete(LegalHold).where(LegalHold.acquisition_id == acquisition))
                else:
                    check_removable(session, acquisition)
                more = {"correlation_id": correlation_id}
                new_entry(session, actor, "acquisition.erase", acquisition, {"erasure": row.id}, **more)
            row.removal = remove_rows(session, found).stored()
            session.add(row)
        self._listed(row)
        return row.id

    def _listed(self, row: Erasure) -> None:
        """Add an erasure to the list outside of the database."""
        entry = {
            "id": row.id,
            "at": row.created_at.isoformat(),
            "specimen_hash": row.specimen_hash,
            "acquisitions": row.acquisitions,
        }
        path = self._settings.data_dir / LIST
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with open(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600), "ab") as file:
                file.write((json_text(entry) + "\n").encode())
                file.flush()
                os.fsync(file.fileno())

    def _finish(self, erasure_id: str) -> Erasure:
        with self._database.session() as session:
            row = session.get_one(Erasure, erasure_id)
            removal = Removal.of(row.removal)
        folders = [self._settings.scratch]
        if self._storage.folder is not None:
            folders.append(self._storage.folder / TEMPORARY)
        files = remove_rest(removal, self._queue, self._storage, folders)
        self._overwrite()
        left = self._left(removal, row.acquisitions, folders)
        seal(self._database, ChainKeys.of(self._settings))
        with self._database.session() as session:
            row = session.get_one(Erasure, erasure_id)
            entry = session.execute(
                sa.select(AuditEntry.seq, AuditEntry.hash)
                .where(AuditEntry.action == "acquisition.erase", AuditEntry.target.in_(row.acquisitions))
                .order_by(AuditEntry.id.desc())
                .limit(1)
            ).one()
            facts = {
                "kind": "specimap erasure certificate",
                "version": 1,
                "specimap_version": __version__,
                "erasure": row.id,
                "specimen_hash": row.specimen_hash,
                "acquisitions": row.acquisitions,
                "begun_at": row.created_at.isoformat(),
                "ended_at": utc_now().isoformat(),
                "by": row.created_by,
                "rows": removal.rows,
                "files": files,
                "workflows": len(removal.workflows),
                "left": left,
                "audit": {"seq": entry.seq, "hash": entry.hash},
            }
            row.certificate = self._signer.signed(facts)
            # Names of what is gone are of no more use.
            row.removal = {}
            row.state = "done"
        return row

    def _overwrite(self) -> None:
        """Take erased pages out of SQLite's journal; deleted content in the file itself is overwritten at once."""
        if self._database.engine.dialect.name != "sqlite":
            return
        for _ in range(CHECKPOINTS):
            with self._database.engine.connect() as connection:
                busy = connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)").one()[0]
            if not busy:
                return
            time.sleep(0.1)

    def _left(self, removal: Removal, acquisitions: list[str], folders: list[Path]) -> dict[str, int]:
        """Count what is still there, by looking again."""
        rows = 0
        with self._database.session() as session:
            for table in Base.metadata.tables.values():
                column = table.c.get("acquisition_id")
                if column is not None and table.name != AuditEntry.__tablename__:
                    query = sa.select(sa.func.count()).select_from(table).where(column.in_(acquisitions))
                    rows += session.scalar(query) or 0
        files = sum(stored_files(self._storage, prefix) for prefix in removal.prefixes)
        return {"rows": rows, "files": files, "scratch": len(leftovers(removal, folders))}


def erased_before(path: Path) -> list[dict[str, Any]]:
    """Read the list of erasures; nothing where there is none. The last line may be cut off."""
    found = []
    try:
        lines = path.read_text("utf-8").splitlines()
    except FileNotFoundError:
        return []
    for line in lines:
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return found


def certificates(session: Session) -> list[dict[str, Any]]:
    """Return the certificates, the newest first."""
    rows = session.scalars(sa.select(Erasure).where(Erasure.state == "done").order_by(Erasure.id.desc()))
    return [row.certificate for row in rows if row.certificate is not None]

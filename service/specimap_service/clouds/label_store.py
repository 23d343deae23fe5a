"""Label layers in storage and database: every version is kept, the highest is the current one."""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.arrays import Array
from specimap_core.atomic import disk_errors, remove
from specimap_core.cloud.labels import describe_label, write_label
from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text
from specimap_infra.audit.entries import name_digest
from specimap_infra.deletion import check_not_held
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.labels import lock_cloud
from specimap_infra.storage import Storage
from specimap_infra.tables import CloudRow, LabelVersion
from specimap_service.auth.keys import Principal
from specimap_service.clouds.label_body import LabelMetadata
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.context import AppContext, audit
from specimap_service.errors import PreconditionFailedError, RequestInvalidError
from specimap_service.space import check_disks, check_quota, over_quota, quota_left

_TAG = re.compile(r'^(W/)?(?:"(\d{1,9})"|(\d{1,9}))$')


@dataclass(frozen=True)
class Conditions:
    """Preconditions of a change: If-Match (versions, or any), If-None-Match: * (none)."""

    versions: frozenset[int] | None = None
    """None: no particular version is required."""
    exists: bool | None = None

    @classmethod
    def of(cls, if_match: str | None, if_none_match: str | None) -> Conditions:
        """Read the preconditions from the headers.

        Raises:
            RequestInvalidError: the headers hold no version.
        """
        if if_none_match is not None:
            if if_none_match.strip() != "*" or if_match is not None:
                raise RequestInvalidError("If-None-Match can be * only, without If-Match.", advice="Use If-Match.")
            return cls(exists=False)
        if if_match is None:
            return cls()
        if if_match.strip() == "*":
            return cls(exists=True)
        found = [_TAG.match(part.strip()) for part in if_match.split(",")]
        if not all(found):
            raise RequestInvalidError("If-Match is no version.", advice='Give the version, as If-Match: "3", or *.')
        # If-Match compares strongly (RFC 9110): a weak tag equals none.
        return cls(frozenset(int(tag[2] or tag[3]) for tag in found if tag and not tag[1]), exists=True)

    def check(self, current: int | None) -> None:
        """Raise PreconditionFailedError where the current version is not what was expected."""
        if (self.exists is not None and self.exists != (current is not None)) or (
            self.versions is not None and current not in self.versions
        ):
            raise PreconditionFailedError(
                f"The layer's version is {current}." if current else "There is no such layer.",
                advice="Read it anew, and send it again if it is still wanted.",
                version=current,
            )


def put_label(
    context: AppContext,
    clouds: OpenClouds,
    principal: Principal,
    cloud_id: str,
    name: str,
    metadata: LabelMetadata,
    values: Array,
    conditions: Conditions,
) -> tuple[LabelVersion, bool]:
    """Store checked values as a layer's next version, unless the current one is the same.

    Returns: the version, and whether it is new.

    Raises:
        NotFoundError: the cloud was deleted meanwhile.
        PreconditionFailedError: the conditions do not hold.
        QuotaExceededError, StorageFullError, StorageUnavailableError: nothing was changed.
    """
    digest = _digest(metadata, values)
    work = context.settings.scratch / f"label-{uuid4().hex}.tmp"
    try:
        with disk_errors(work):
            write_label(work, values)
        size = sum(file.stat().st_size for file in work.rglob("*") if file.is_file())
        prefix: str | None = None
        try:
            with context.database.session() as session:
                lock_cloud(session, cloud_id)
                current = _current(session, cloud_id, name)
                if current is not None and current.sha256 == digest:
                    return current, False
                conditions.check(current.version if current else None)
                check_disks(context, size)
                check_quota(session, principal, size)
                version = current.version + 1 if current else 1
                # The suffix keeps a layer that is deleted and created again apart from the files of the first.
                prefix = f"clouds/{cloud_id}/labels/{name}/v{version}-{uuid4().hex[:8]}"
                stored = metadata.as_stored()
                row = LabelVersion(
                    cloud_id=cloud_id,
                    name=name,
                    version=version,
                    kind=metadata.kind,
                    classes=stored["classes"],
                    made_by=stored["made_by"],
                    storage_prefix=prefix,
                    sha256=digest,
                    size=size,
                    created_by=principal.key_id,
                )
                session.add(row)
                layer = name_digest(cloud_id, name)
                audit(session, principal.key_id, "label.put", cloud_id, layer=layer, version=version)
                session.flush()
                _publish(context.storage, work, prefix, {**stored, "version": version})
        except DatabaseUnavailableError:
            raise  # the row may have been committed after all, and refer to the files
        except BaseException:
            if prefix is not None:
                context.storage.delete(prefix)
            raise
    finally:
        remove(work)
    clouds.forget(cloud_id)
    return row, True


def check_room(context: AppContext, principal: Principal, announced: int) -> None:
    """Check before a body is read whether the disks and the key's quota leave room for it.

    Raises:
        QuotaExceededError, StorageFullError: they do not.
    """
    check_disks(context, announced)
    with context.database.session() as session:
        # How small the values become is known once they are written.
        if quota_left(session, principal) <= 0:
            raise over_quota(principal, announced)


def delete_label(
    context: AppContext,
    clouds: OpenClouds,
    principal: Principal,
    cloud_id: str,
    name: str,
    conditions: Conditions,
) -> None:
    """Remove a layer with all its versions.

    Raises:
        NotFoundError: there is no such cloud or layer.
        PreconditionFailedError: the conditions do not hold.
    """
    with context.database.session() as session:
        lock_cloud(session, cloud_id)
        layer = sa.and_(LabelVersion.cloud_id == cloud_id, LabelVersion.name == name)
        prefixes = list(session.scalars(sa.select(LabelVersion.storage_prefix).where(layer)))
        if not prefixes:
            raise no_label(cloud_id, name)
        conditions.check(session.scalar(sa.select(sa.func.max(LabelVersion.version)).where(layer)))
        check_not_held(session, session.get_one(CloudRow, cloud_id).acquisition_id)
        session.execute(sa.delete(LabelVersion).where(layer))
        digest = name_digest(cloud_id, name)
        audit(session, principal.key_id, "label.delete", cloud_id, layer=digest, versions=len(prefixes))
    clouds.forget(cloud_id)
    for prefix in prefixes:
        context.storage.delete(prefix)


def find_label(session: Session, cloud_id: str, name: str, version: int | None) -> LabelVersion:
    """Return a version of a layer, by default the current one.

    Raises:
        NotFoundError: there is none.
    """
    found = (
        _current(session, cloud_id, name)
        if version is None
        else session.get(LabelVersion, {"cloud_id": cloud_id, "name": name, "version": version})
    )
    if found is None:
        raise no_label(cloud_id, name, version)
    return found


def no_label(cloud_id: str, name: str, version: int | None = None) -> NotFoundError:
    """Make the error for a layer, or a version of it, that does not exist."""
    which = "" if version is None else f" of version {version}"
    return NotFoundError(
        f"Cloud {cloud_id} has no label layer {name!r}{which}.", advice=f"GET /v1/clouds/{cloud_id}/labels lists all."
    )


def _current(session: Session, cloud_id: str, name: str) -> LabelVersion | None:
    query = sa.select(LabelVersion).where(LabelVersion.cloud_id == cloud_id, LabelVersion.name == name)
    return session.scalar(query.order_by(LabelVersion.version.desc()).limit(1))


def _publish(storage: Storage, work: Path, prefix: str, attributes: dict[str, Any]) -> None:
    describe_label(work, attributes)
    with storage.publishing(prefix) as folder:
        for item in list(work.iterdir()):
            shutil.move(item, folder / item.name)


def _digest(metadata: LabelMetadata, values: Array) -> str:
    text = json_text([metadata.as_stored(), values.dtype.str, values.shape], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    digest.update(values.tobytes())
    return digest.hexdigest()

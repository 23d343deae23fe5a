"""Takes DICOM objects in: a segmentation of a result's top view becomes a label layer, photos become an acquisition."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
from pydantic import ValidationError
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from specimap_core.cloud.labels import checked_labels
from specimap_core.errors import NotFoundError, SpecimapError
from specimap_core.pipeline.options import DEFAULTS
from specimap_hospital.outbox.making import fetch_without_spectra
from specimap_hospital.receive.classes import (
    CANNOT_PROCESS,
    CANNOT_UNDERSTAND,
    NO_SUCH_OBJECT,
    NOT_AUTHORISED,
    OUT_OF_RESOURCES,
)
from specimap_hospital.receive.confined import UnreadableError, ask_reader
from specimap_infra.database import utc_now
from specimap_infra.errors import DatabaseUnavailableError, StorageUnavailableError
from specimap_infra.ids import new_id
from specimap_infra.logs import logger
from specimap_infra.studies import find_study, put_study
from specimap_infra.study_context import StudyContext
from specimap_infra.study_keys import StudyKeys
from specimap_infra.tables import Acquisition, CloudRow, DicomInstance, DicomSet, ReceivedStudy, SealedStudy
from specimap_service.acquisitions.inspection import Arrival
from specimap_service.acquisitions.intake import take_in
from specimap_service.acquisitions.judge import Judge
from specimap_service.auth.access import in_sight
from specimap_service.auth.keys import Principal
from specimap_service.auth.permissions import CAPTURE, LABEL
from specimap_service.clouds.label_body import LabelMetadata
from specimap_service.clouds.label_store import Conditions, put_label
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.context import AppContext, audit
from specimap_service.errors import QuotaExceededError

ON_TOP_VIEW = ("top_view", "preview", "reference_image")
"""Objects whose pixels are those of the top view."""
UNLABELLED = {"value": 0, "name": "unlabelled"}


@dataclass(frozen=True)
class Taken:
    """What became of an object. ``failure``: why it was not taken, a code of DICOM; None where it was."""

    sop_class_uid: str
    sop_instance_uid: str
    failure: int | None


@dataclass(frozen=True)
class Intake:
    """Takes the objects of one request in."""

    context: AppContext
    judge: Judge
    clouds: OpenClouds
    principal: Principal

    def take(self, path: Path, folder: Path) -> Taken:
        """Take one object in; ``folder`` is for this one alone. Blocks for some seconds.

        Raises:
            DatabaseUnavailableError, StorageUnavailableError: try it again later.
        """
        found: dict[str, Any] = {}
        try:
            request = {"task": "read", "path": str(path), "name": "object"}
            found = ask_reader(self.context.settings, request, folder, [path])
            if found.get("kind") == "segmentation":
                self._label(found, folder)
            else:
                self._photo(found, folder)
            failure = None
        except UnreadableError as error:
            failure = error.failure
        except (DatabaseUnavailableError, StorageUnavailableError):
            raise
        except QuotaExceededError:
            failure = OUT_OF_RESOURCES
        except SpecimapError as error:
            logger().warning("dicom object not taken", code=error.code)
            failure = CANNOT_PROCESS
        except (KeyError, TypeError, ValueError, OSError, EOFError):
            # An answer of a reader that a file has taken over.
            failure = CANNOT_UNDERSTAND
        sop_class, instance = (_uid(found.get(name)) for name in ("sop_class_uid", "sop_instance_uid"))
        return Taken(sop_class, instance, failure)

    # ---- segmentations --------------------------------------------------------------------------------

    def _label(self, found: dict[str, Any], folder: Path) -> None:
        if not self.principal.may(LABEL):
            raise UnreadableError(NOT_AUTHORISED)
        with self.context.database.session() as session:
            cloud = self._referenced(session, [str(uid) for uid in found["references"]])
        given = folder / "cloud"
        fetch_without_spectra(self.context.storage, cloud.prefix, given)
        self.context.storage.fetch(f"{cloud.prefix}/corners.json", given / "corners.json")
        pixels = folder / "object.npy"
        request = {"task": "map", "path": str(pixels), "folder": str(given), "place": found["place"]}
        ask_reader(self.context.settings, request, folder / "points", [pixels, given])
        values = np.load(folder / "points" / "points.npy", allow_pickle=False)
        if values.shape != (cloud.points,) or values.dtype != np.uint16:
            raise UnreadableError(CANNOT_UNDERSTAND)
        metadata = _metadata(found)
        checked = checked_labels(values, "class", [item.value for item in metadata.classes], cloud.points)
        name = re.sub(r"[^A-Za-z0-9_-]+", "-", str(found["name"]))[:64].strip("-") or "segmentation"
        put_label(self.context, self.clouds, self.principal, cloud.id, name.lower(), metadata, checked, Conditions())

    def _referenced(self, session: Session, uids: list[str]) -> CloudRow:
        """The one result whose top view is referred to. Raises UnreadableError."""
        query = (
            sa.select(CloudRow)
            .join(DicomSet, DicomSet.cloud_id == CloudRow.id)
            .join(DicomInstance, DicomInstance.set_id == DicomSet.id)
            .where(DicomInstance.sop_instance_uid.in_(uids), DicomInstance.kind.in_(ON_TOP_VIEW))
            .where(in_sight(self.principal, CloudRow))
            .distinct()
        )
        found = {row.id: row for row in session.scalars(query)}
        if len(found) != 1:
            raise UnreadableError(NO_SUCH_OBJECT)
        return next(iter(found.values()))

    # ---- photos ---------------------------------------------------------------------------------------

    def _photo(self, found: dict[str, Any], folder: Path) -> None:
        # In which of several projects an acquisition belongs, an object does not say.
        if not self.principal.may(CAPTURE) or len(self.principal.project_ids) != 1:
            raise UnreadableError(NOT_AUTHORISED)
        # Photos are put together by their study, and say whose they are: neither may be open.
        if not found["study_uid"] or found["study"] is None:
            raise UnreadableError(CANNOT_UNDERSTAND)
        photo = folder / Path(str(found["file"])).name
        content = photo.read_bytes()
        if len(content) > self.context.settings.max_photo_bytes:
            raise UnreadableError(CANNOT_PROCESS)
        acquisition_id = self._acquisition(str(found["study_uid"]), found["study"])
        stored = take_in(
            self.context,
            self.judge,
            Arrival(
                new_id("file"),
                acquisition_id,
                "photo",
                f"object{photo.suffix}",
                photo,
                len(content),
                hashlib.sha256(content).hexdigest(),
                self.principal.key_id,
                self.principal,
            ),
        )
        # One that is sent again is there already.
        if stored.state == "refused" and stored.judgement.get("code") != "photo_duplicate":
            raise UnreadableError(CANNOT_PROCESS)

    def _acquisition(self, study_uid: str, study: dict[str, Any] | None) -> str:
        """The acquisition of a study's photos, new for the first one."""
        digest = hashlib.sha256(f"{self.principal.project_ids[0]}/{study_uid}".encode()).hexdigest()
        for _ in range(2):
            try:
                with self.context.database.session() as session:
                    known = session.get(ReceivedStudy, digest)
                    if known is not None:
                        self._check_patient(session, known.acquisition_id, study)
                        return known.acquisition_id
                    return self._new_acquisition(session, digest, study)
            except IntegrityError:
                continue  # another one of the same study came first
        raise NotFoundError("The acquisition is gone.", advice="Send the object again.")

    def _check_patient(self, session: Session, acquisition_id: str, study: dict[str, Any] | None) -> None:
        """Raise UnreadableError where a study's photo names another patient than those before it."""
        keys = StudyKeys.of_settings(self.context.settings)
        known = find_study(session, keys, acquisition_id) if keys else None
        if known is not None and study is not None and study.get("patient_id") != known.context.patient_id:
            raise UnreadableError(CANNOT_PROCESS)

    def _new_acquisition(self, session: Session, digest: str, study: dict[str, Any] | None) -> str:
        row = Acquisition(
            id=new_id("acq"),
            project_id=self.principal.project_ids[0],
            specimen_id=f"dicom-{digest[:16]}",
            dictionary=DEFAULTS.dictionary,
            edge_mm=DEFAULTS.edge_mm,
            notes="",
            created_by=self.principal.key_id,
            created_at=utc_now(),
        )
        session.add(row)
        session.flush()
        session.add(ReceivedStudy(digest=digest, acquisition_id=row.id))
        audit(session, self.principal.key_id, "acquisition.create", row.id)
        session.flush()
        keys = StudyKeys.of_settings(self.context.settings)
        if keys and study is not None and session.get(SealedStudy, row.id) is None:
            try:
                context = StudyContext.model_validate(study)
            except ValidationError:
                raise UnreadableError(CANNOT_UNDERSTAND) from None
            put_study(session, keys, row.id, context, self.principal.key_id)
            audit(session, self.principal.key_id, "study.put", row.id, version=1)
        return row.id


def _uid(value: object) -> str:
    """A UID, or nothing."""
    return value if isinstance(value, str) and re.fullmatch(r"[0-9.]{1,64}", value) else ""


def _metadata(found: dict[str, Any]) -> LabelMetadata:
    """What a label layer says of itself, from a segmentation. Raises UnreadableError."""
    classes, names = [UNLABELLED], {"unlabelled"}
    for number, name in sorted((int(number), str(name)) for number, name in found["segments"].items()):
        text = "".join(c for c in name if c.isprintable())[:90] or f"segment {number}"
        text = text if text not in names else f"{text} ({number})"
        names.add(text)
        classes.append({"value": number, "name": text})
    made_by = {"name": str(found["maker"])[:200] or "DICOM", "version": str(found["version"])[:200] or None}
    try:
        return LabelMetadata.model_validate({"kind": "class", "classes": classes, "made_by": made_by})
    except ValidationError:
        raise UnreadableError(CANNOT_UNDERSTAND) from None

"""Orders of a modality worklist, by C-FIND."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from specimap_hospital.connections import PeerError, association, entity
from specimap_hospital.orders.model import MOST_ORDERS, OrderQuery
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

MATCHES = (0xFF00, 0xFF01)
RETURNED = (
    *("PatientName", "PatientID", "IssuerOfPatientID", "PatientBirthDate", "PatientSex", "ReferringPhysicianName"),
    *("AccessionNumber", "StudyInstanceUID", "StudyID", "RequestedProcedureID", "RequestedProcedureDescription"),
)
OF_STEP = (
    *("Modality", "ScheduledStationAETitle", "ScheduledProcedureStepStartDate", "ScheduledProcedureStepStartTime"),
    *("ScheduledProcedureStepID", "ScheduledProcedureStepDescription"),
)


def find_in_worklist(settings: ServiceSettings, query: OrderQuery) -> tuple[list[Dataset], bool]:
    """Ask the worklist. Returns what it found, at most 50, and whether there is more.

    Raises:
        PeerError: it does not answer in time, or refuses. SettingsError: the certificates do not read.
    """
    end = time.monotonic() + settings.orders_seconds
    ae = entity(settings, settings.orders_seconds)
    from pynetdicom.sop_class import ModalityWorklistInformationFind  # type: ignore[attr-defined]

    ae.add_requested_context(ModalityWorklistInformationFind)
    found: list[Dataset] = []
    host, port, title = settings.worklist_host, settings.worklist_port, settings.worklist_ae_title
    with association(ae, settings, host, port, title, tls=settings.worklist_tls == "on") as peer:
        if not peer.accepted_contexts:
            raise PeerError("worklist_not_offered", passing=False)
        try:
            for status, match in peer.send_c_find(_identifier(query), ModalityWorklistInformationFind):
                code = status.get("Status") if status else None
                if code in MATCHES and match is not None:
                    if len(found) == MOST_ORDERS:
                        # Ending the association ends the answer, which a cancellation only asks for.
                        peer.abort()
                        return found, True
                    found.append(match)
                elif code == 0x0000:
                    return found, False
                elif code is None or code not in MATCHES:
                    raise PeerError("no_answer" if code is None else f"status_{code:04x}")
                if time.monotonic() > end:
                    peer.abort()
                    raise PeerError("no_answer")
        except (ValueError, AttributeError, RuntimeError):
            raise PeerError("answer_unreadable") from None
    return found, False


def _identifier(query: OrderQuery) -> Dataset:

    step = _empty(OF_STEP)
    step.ScheduledStationAETitle = query.station
    specimen = _empty(("ContainerIdentifier",))
    specimen.IssuerOfTheContainerIdentifierSequence = [_issuer()]
    described = _empty(("SpecimenIdentifier", "SpecimenUID", "SpecimenShortDescription"))
    described.IssuerOfTheSpecimenIdentifierSequence = [_issuer()]
    specimen.SpecimenDescriptionSequence = [described]
    step.ScheduledSpecimenSequence = [specimen]
    asked: Dataset = _empty(RETURNED)
    asked.SpecificCharacterSet = "ISO_IR 192"
    asked.AccessionNumber = query.accession_number
    asked.PatientID = query.patient_id
    asked.IssuerOfAccessionNumberSequence = [_issuer()]
    asked.ScheduledProcedureStepSequence = [step]
    return asked


def _issuer() -> Dataset:
    return _empty(("LocalNamespaceEntityID", "UniversalEntityID", "UniversalEntityIDType"))


def _empty(keywords: tuple[str, ...]) -> Dataset:
    from pydicom.dataset import Dataset

    made = Dataset()
    for keyword in keywords:
        setattr(made, keyword, "")
    return made

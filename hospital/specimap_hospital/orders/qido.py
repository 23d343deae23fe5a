"""Studies that a DICOMweb server knows, as orders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from specimap_hospital.connections import dicomweb, web_errors
from specimap_hospital.orders.model import MOST_ORDERS, OrderQuery
from specimap_infra.settings import ServiceSettings

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

FIELDS = (
    *("StudyInstanceUID", "AccessionNumber", "PatientID", "IssuerOfPatientID", "PatientName", "PatientBirthDate"),
    *("PatientSex", "ReferringPhysicianName", "StudyID", "StudyDescription", "StudyDate", "StudyTime"),
)


def find_studies(settings: ServiceSettings, query: OrderQuery) -> tuple[list[Dataset], bool]:
    """Ask the server. Returns what it found, at most 50, and whether there is more.

    Raises:
        PeerError: it does not answer in time, or refuses. SettingsError: the certificates do not read.
    """
    asked = {"AccessionNumber": query.accession_number, "PatientID": query.patient_id}
    filters = {name: value for name, value in asked.items() if value}
    if not filters:
        # Studies name no station; without a filter it would list them all.
        return [], False
    client = dicomweb(
        settings,
        settings.orders_url,
        token=settings.orders_token,
        user=settings.orders_user,
        password=settings.orders_password,
        seconds=settings.orders_seconds,
    )
    from pydicom.dataset import Dataset

    with web_errors():
        found = client.search_for_studies(search_filters=filters, fields=FIELDS, limit=MOST_ORDERS + 1)
        datasets = [Dataset.from_json(item) for item in found[: MOST_ORDERS + 1]]
    return datasets[:MOST_ORDERS], len(datasets) > MOST_ORDERS

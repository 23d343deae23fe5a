"""What an export's file depends on beside its result: label layers, and the key of pseudonyms."""

from __future__ import annotations

from collections.abc import Iterable

from specimap_core.export.formats import DEIDENTIFIED, WITH_LABELS, FileFormat
from specimap_infra.labels import fingerprint
from specimap_infra.pseudonyms import Pseudonyms
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import LabelVersion


def state_hash(format: FileFormat, labels: Iterable[LabelVersion], settings: ServiceSettings) -> str:
    """Return a text that changes whenever the file is to be made again; empty where nothing changes it.

    Raises:
        SettingsError: the format needs the key of pseudonyms, and there is none.
    """
    if format not in WITH_LABELS:
        return ""
    found = fingerprint(labels)
    return f"{found}:{Pseudonyms.of(settings).key_id}" if format in DEIDENTIFIED else found

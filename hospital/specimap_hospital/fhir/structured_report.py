"""Reading a TID 1500 structured report: the measurement groups that become Observations.

Follows the content that HL7's guide for mapping DICOM SR to FHIR reads: containers ``Measurement Group`` (125007, DCM)
below ``Imaging Measurements`` (126010, DCM), their NUM items, and their CODE and TEXT items as qualitative evaluations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pydicom.dataset import Dataset

from specimap_hospital.fhir.errors import StructuredReportError

IMAGING_MEASUREMENTS = ("126010", "DCM")
MEASUREMENT_GROUP = ("125007", "DCM")
TRACKING_IDENTIFIER = ("112039", "DCM")
TRACKING_UID = ("112040", "DCM")
FINDING = ("121071", "DCM")
FINDING_CATEGORY = ("276214006", "SCT")
ALGORITHM_NAME = ("111001", "DCM")
ALGORITHM_VERSION = ("111003", "DCM")
_CONTEXT = {TRACKING_IDENTIFIER, TRACKING_UID, FINDING, FINDING_CATEGORY, ALGORITHM_NAME, ALGORITHM_VERSION}
_DESCRIPTION = ("HAS OBS CONTEXT", "HAS CONCEPT MOD", "HAS ACQ CONTEXT")
"""Relationships of items that say how a group was made, which are no evaluations."""


@dataclass(frozen=True)
class Code:
    """A coded concept: value, coding scheme designator and meaning."""

    value: str
    scheme: str
    meaning: str

    @property
    def key(self) -> tuple[str, str]:
        """Value and scheme, which identify it."""
        return self.value, self.scheme


@dataclass(frozen=True)
class Measurement:
    """A NUM item. ``uid`` is its observation UID, empty where it has none."""

    uid: str
    concept: Code
    value: float
    unit: Code


@dataclass(frozen=True)
class Evaluation:
    """A CODE or TEXT item: its value is a code, or a text."""

    uid: str
    concept: Code
    value: Code | str


@dataclass(frozen=True)
class MeasurementGroup:
    """A measurement group with its own identity, label and finding."""

    uid: str
    label: str
    category: Code | None
    finding: Code | None
    measurements: tuple[Measurement, ...]
    evaluations: tuple[Evaluation, ...]


def measurement_groups(report: Dataset) -> list[MeasurementGroup]:
    """Return the measurement groups of a report, in its order.

    Raises:
        StructuredReportError: it holds no container of imaging measurements, or an item that does not read.
    """
    try:
        found = [item for item in _children(report) if _concept(item).key == IMAGING_MEASUREMENTS]
        if not found:
            raise StructuredReportError(
                "The structured report holds no imaging measurements.", advice="Give a report of template TID 1500."
            )
        groups = (item for container in found for item in _children(container))
        return [_group(item) for item in groups if _concept(item).key == MEASUREMENT_GROUP]
    except (AttributeError, IndexError, TypeError, ValueError) as error:
        raise StructuredReportError(
            "The structured report has an item that does not read.", advice="Build the objects of the result again."
        ) from error


def _group(group: Dataset) -> MeasurementGroup:
    items = list(_children(group))
    named = {_concept(item).key: item for item in reversed(items)}
    uid, label = named.get(TRACKING_UID), named.get(TRACKING_IDENTIFIER)
    category, finding = named.get(FINDING_CATEGORY), named.get(FINDING)
    evaluations = [
        Evaluation(_uid(item), _concept(item), _code(item) if item.ValueType == "CODE" else str(item.TextValue))
        for item in items
        if item.ValueType in ("CODE", "TEXT")
        and item.RelationshipType not in _DESCRIPTION
        and _concept(item).key not in _CONTEXT
    ]
    return MeasurementGroup(
        uid=str(uid.UID) if uid is not None else _uid(group),
        label="" if label is None else str(label.TextValue),
        category=None if category is None else _code(category),
        finding=None if finding is None else _code(finding),
        # A NUM item may be without a value, which says that it could not be measured.
        measurements=tuple(
            _measurement(item) for item in items if item.ValueType == "NUM" and item.get("MeasuredValueSequence")
        ),
        evaluations=tuple(evaluations),
    )


def _measurement(item: Dataset) -> Measurement:
    measured = item.MeasuredValueSequence[0]
    exact = measured.get("FloatingPointValue")
    value = float(measured.NumericValue if exact is None else exact)
    return Measurement(_uid(item), _concept(item), value, _as_code(measured.MeasurementUnitsCodeSequence[0]))


def _children(item: Dataset) -> Iterator[Dataset]:
    # Items by reference have no value of their own.
    return (child for child in item.get("ContentSequence") or () if "ValueType" in child)


def _concept(item: Dataset) -> Code:
    names = item.get("ConceptNameCodeSequence")
    return _as_code(names[0]) if names else Code("", "", "")


def _code(item: Dataset) -> Code:
    return _as_code(item.ConceptCodeSequence[0])


def _as_code(code: Dataset) -> Code:
    value = code.get("CodeValue") or code.get("LongCodeValue") or code.get("URNCodeValue") or ""
    return Code(str(value), str(code.get("CodingSchemeDesignator", "")), str(code.get("CodeMeaning", "")))


def _uid(item: Dataset) -> str:
    return str(item.get("ObservationUID", ""))

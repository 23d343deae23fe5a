"""Observations from the measurement groups of a structured report, as HL7's guide "DICOM SR to FHIR" maps them.

The guide is written for R5. Here it is followed in R4, in which ImagingSelection does not exist: an observation refers
to the study alone, by ``partOf`` and ``derivedFrom``.
"""

from __future__ import annotations

from dataclasses import dataclass

from specimap_hospital.fhir.elements import (
    Element,
    concept,
    derived_uid,
    full_url,
    observation_identifier,
    quantity,
)
from specimap_hospital.fhir.structured_report import Code, MeasurementGroup

GROUP = Code("125007", "DCM", "Measurement Group")


@dataclass(frozen=True)
class Shared:
    """Elements that all observations of a report have; ``name`` is the UID of the report."""

    name: str
    elements: Element


@dataclass(frozen=True)
class Observed:
    """An observation with its UID and its place in the bundle."""

    uid: str
    url: str
    resource: Element


def observations(groups: list[MeasurementGroup], shared: Shared) -> tuple[list[Observed], list[str]]:
    """Return all observations, and the places of the groups, to which a report refers."""
    made: list[Observed] = []
    tops: list[str] = []
    for number, group in enumerate(groups):
        members = [
            *(
                _observed(
                    shared,
                    item.uid or derived_uid(shared.name, str(number), "measurement", str(index)),
                    {"code": concept(item.concept), "valueQuantity": quantity(item.value, item.unit)},
                )
                for index, item in enumerate(group.measurements)
            ),
            *(
                _observed(
                    shared,
                    item.uid or derived_uid(shared.name, str(number), "evaluation", str(index)),
                    {"code": concept(item.concept), **_value(item.value)},
                )
                for index, item in enumerate(group.evaluations)
            ),
        ]
        content: Element = {"code": concept(group.category or GROUP)}
        if group.label:
            content["code"] = concept(group.category or GROUP) | {"text": group.label}
        if group.category is not None:
            # Otherwise the code says it, and the guide forbids it twice.
            content["category"] = [concept(GROUP)]
        if group.finding is not None:
            content["valueCodeableConcept"] = concept(group.finding)
        if members:
            content["hasMember"] = [{"reference": member.url} for member in members]
        top = _observed(shared, group.uid or derived_uid(shared.name, str(number)), content)
        made += [*members, top]
        tops.append(top.url)
    return made, tops


def _observed(shared: Shared, uid: str, content: Element) -> Observed:
    own: Element = {"resourceType": "Observation", "identifier": [observation_identifier(uid)]}
    return Observed(uid, full_url("Observation", shared.name, uid), own | shared.elements | content)


def _value(value: Code | str) -> Element:
    return {"valueString": value} if isinstance(value, str) else {"valueCodeableConcept": concept(value)}

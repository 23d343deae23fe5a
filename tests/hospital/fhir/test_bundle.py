"""The transaction of a result, against its structured report and the definitions of FHIR R4."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any
from urllib.parse import unquote

import pytest

from specimap_hospital.fhir.bundle import transaction
from specimap_hospital.fhir.elements import Systems
from specimap_hospital.fhir.errors import PatientMissingError, StructuredReportError
from specimap_hospital.fhir.structured_report import measurement_groups
from tests.hospital.fhir.scene import CONTEXT, STUDY, VALUES, report, result
from tests.hospital.fhir.validation import validated

SYSTEMS = Systems(accession="urn:example:orders")


def resources(bundle: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [entry["resource"] for entry in bundle["entry"] if entry["resource"]["resourceType"] == kind]


def test_the_groups_of_a_report_are_read_as_written() -> None:
    (group,) = measurement_groups(report())
    assert group.label == "Marker corners"
    assert group.uid == "1.2.826.0.1.3680043.9.7.5"
    assert {item.concept.meaning: item.value for item in group.measurements} == VALUES
    assert {(item.unit.value, item.unit.scheme) for item in group.measurements} == {("mm", "UCUM")}
    assert [item.concept.meaning for item in group.evaluations] == ["Verdict"]


def test_a_bundle_keeps_to_the_definitions_of_r4() -> None:
    bundle = transaction(CONTEXT, result(), SYSTEMS)
    assert validated(bundle) == []
    # The validator does find what is wrong.
    resources(bundle, "DiagnosticReport")[0]["status"] = "bogus"
    resources(bundle, "Observation")[0].pop("code")
    resources(bundle, "Specimen")[0]["colour"] = "red"
    assert {message["location"] for message in validated(bundle)} == {
        "DiagnosticReport.status",
        "Observation.code",
        "Specimen.colour",
    }


def test_observations_are_those_of_the_structured_report() -> None:
    bundle = transaction(CONTEXT, result(), SYSTEMS)
    by_url = {entry["fullUrl"]: entry["resource"] for entry in bundle["entry"]}
    (told,) = resources(bundle, "DiagnosticReport")
    (group,) = (by_url[reference["reference"]] for reference in told["result"])
    members = [by_url[reference["reference"]] for reference in group["hasMember"]]
    figures = {member["code"]["text"]: member["valueQuantity"] for member in members if "valueQuantity" in member}
    assert {name: figure["value"] for name, figure in figures.items()} == VALUES
    assert {figure["code"] for figure in figures.values()} == {"mm"}
    assert [member["valueCodeableConcept"]["text"] for member in members if "valueCodeableConcept" in member] == [
        "Trustworthy"
    ]
    assert group["identifier"][0]["value"] == "urn:oid:1.2.826.0.1.3680043.9.7.5"
    for observation in resources(bundle, "Observation"):
        assert by_url[observation["partOf"][0]["reference"]]["resourceType"] == "ImagingStudy"
        assert by_url[observation["device"]["reference"]]["deviceName"][0]["name"] == "Specimap"
        assert by_url[observation["specimen"]["reference"]]["container"][0]["identifier"][0]["value"] == "BOX-1"
        assert observation["subject"]["identifier"] == {"system": "urn:example:patients", "value": "PID-7"}
        assert observation["basedOn"][0]["identifier"]["system"] == "urn:example:orders"
    assert told["status"] == "preliminary"
    assert told["conclusion"] == "The figures can be trusted. For research use only; not for diagnosis."


def test_the_study_lists_the_instances_that_were_sent() -> None:
    (study,) = resources(transaction(CONTEXT, result(), SYSTEMS), "ImagingStudy")
    assert study["identifier"] == [{"system": "urn:dicom:uid", "value": f"urn:oid:{STUDY}"}]
    assert study["numberOfInstances"] == 1
    assert study["series"][0]["instance"][0]["uid"] == "1.2.826.0.1.3680043.9.7.3"


def test_without_an_archive_no_study_is_told_of() -> None:
    bundle = transaction(CONTEXT, replace(result(), instances=[]), SYSTEMS)
    assert "ImagingStudy" not in json.dumps(bundle)
    assert len(resources(bundle, "Observation")) == 4
    assert validated(bundle) == []


def test_sent_again_a_bundle_finds_what_it_made() -> None:
    first, second = (transaction(CONTEXT, result(report()), SYSTEMS) for _ in range(2))
    assert [entry["request"] for entry in first["entry"]] == [entry["request"] for entry in second["entry"]]
    assert [entry["fullUrl"] for entry in first["entry"]] == [entry["fullUrl"] for entry in second["entry"]]
    methods = {entry["resource"]["resourceType"]: entry["request"]["method"] for entry in first["entry"]}
    assert methods == {
        "Specimen": "POST",
        "ImagingStudy": "POST",
        "Device": "POST",
        "Observation": "PUT",
        "DiagnosticReport": "PUT",
    }
    for entry in first["entry"]:
        request = entry["request"]
        query = request.get("ifNoneExist") or request["url"].partition("?")[2]
        system, _, value = unquote(query.removeprefix("identifier=")).partition("|")
        assert (system, value) in {(i.get("system"), i["value"]) for i in entry["resource"]["identifier"]}
    # Each observation has an identity of its own.
    urls = [entry["request"]["url"] for entry in first["entry"] if entry["request"]["method"] == "PUT"]
    assert len(set(urls)) == len(urls)


def test_a_specimen_is_looked_for_by_what_is_unique() -> None:
    def query(systems: Systems) -> str:
        bundle = transaction(CONTEXT, result(), systems)
        return unquote(bundle["entry"][0]["request"]["ifNoneExist"])

    # Another hospital may have a specimen SP-1, too.
    assert query(SYSTEMS) == "identifier=urn:dicom:uid|urn:oid:1.2.826.0.1.3680043.9.7.6"
    assert query(Systems(specimen="urn:example:specimens")) == "identifier=urn:example:specimens|SP-1"


def test_without_a_patient_nothing_is_told() -> None:
    with pytest.raises(PatientMissingError) as caught:
        transaction(CONTEXT.model_copy(update={"patient_id": ""}), result(), SYSTEMS)
    assert "Doe" not in str(caught.value.as_dict())


def test_other_documents_are_refused() -> None:
    document = report()
    document.ContentSequence = document.ContentSequence[:2]
    with pytest.raises(StructuredReportError):
        transaction(CONTEXT, result(document), SYSTEMS)
    broken = report()
    for item in broken.ContentSequence:
        for group in item.get("ContentSequence", []):
            for number in group.get("ContentSequence", []):
                if number.ValueType == "NUM":
                    measured = number.MeasuredValueSequence[0]
                    measured.NumericValue = None
                    measured.pop("FloatingPointValue", None)
    with pytest.raises(StructuredReportError):
        transaction(CONTEXT, result(broken), SYSTEMS)

"""Entries of the audit trail as DICOM audit messages (PS3.15 A.5) and as lines of JSON."""

from __future__ import annotations

import base64
import datetime
import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

from specimap_core.json_text import json_text
from specimap_hospital.audit.event_codes import Code, event_of
from specimap_infra.audit.records import FIELDS

OUTCOMES = {"success": "0", "refused": "4", "failed": "8"}
"""EventOutcomeIndicator: success, minor failure, serious failure."""
SYSTEM = "99SPECIMAP"
"""Code system of our own kinds of objects."""
KINDS = {
    "acq": "acquisition",
    "file": "file",
    "up": "upload",
    "job": "job",
    "cloud": "result",
    "exp": "export",
    "shr": "share",
    "key": "key",
    "prj": "project",
}
_SECURITY_RESOURCE, _REPORT, _SECURITY_USER = "13", "3", "11"
_SOURCE_TYPE = "4"
"""Application server process."""


@dataclass(frozen=True)
class Source:
    """Where messages come from: AuditSourceID, AuditEnterpriseSiteID."""

    id: str
    site: str = ""


def json_line(entry: Mapping[str, Any]) -> str:
    """Return an entry as one line of JSON, with its place in the chain."""
    values = {name: entry[name] for name in (*FIELDS, "seq", "previous_hash", "hash")}
    values["at"] = _time(entry["at"])
    return json_text(values, separators=(",", ":"))


def dicom_message(entry: Mapping[str, Any], source: Source) -> str:
    """Return an entry as an audit message: XML without a declaration, in one line."""
    event = event_of(str(entry["action"]), entry["status"])
    message = ElementTree.Element("AuditMessage")
    identification = ElementTree.SubElement(
        message,
        "EventIdentification",
        EventActionCode=event.action,
        EventDateTime=_time(entry["at"]),
        EventOutcomeIndicator=OUTCOMES[str(entry["outcome"])],
    )
    _coded(identification, "EventID", event.id)
    for code in (*event.types, Code(str(entry["action"]), str(entry["action"]), SYSTEM)):
        _coded(identification, "EventTypeCode", code)
    if entry["status"] is not None and entry["outcome"] != "success":
        ElementTree.SubElement(identification, "EventOutcomeDescription").text = f"HTTP status {entry['status']}"
    person = entry["key_id"] not in ("service", "cli")
    if person:
        _participant(message, str(entry["key_id"]) or "unknown", requestor=True, address=str(entry["address"]))
    _participant(message, source.id, requestor=not person, name="Specimap")
    origin = {"AuditEnterpriseSiteID": source.site} if source.site else {}
    audit_source = ElementTree.SubElement(message, "AuditSourceIdentification", {**origin, "AuditSourceID": source.id})
    ElementTree.SubElement(audit_source, "AuditSourceTypeCode", {"csd-code": _SOURCE_TYPE})
    objects = [entry["target"], *([entry["acquisition_id"]] if entry["acquisition_id"] != entry["target"] else [])]
    for index, object_id in enumerate(name for name in objects if name):
        _object(message, str(object_id), entry if index == 0 else None)
    if not any(objects):
        _object(message, "service", entry)
    return ElementTree.tostring(message, encoding="unicode")


def _time(at: datetime.datetime) -> str:
    return at.astimezone(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _coded(parent: ElementTree.Element, name: str, code: Code) -> None:
    values = {"csd-code": code.value, "codeSystemName": code.system, "originalText": code.meaning}
    ElementTree.SubElement(parent, name, values)


def _participant(
    message: ElementTree.Element, user: str, *, requestor: bool, address: str = "", name: str = ""
) -> None:
    values = {"UserID": user, "UserIsRequestor": "true" if requestor else "false"}
    if name:
        values["UserName"] = name
    if address:
        values |= {"NetworkAccessPointID": address, "NetworkAccessPointTypeCode": "2" if _is_ip(address) else "5"}
    ElementTree.SubElement(message, "ActiveParticipant", values)


def _is_ip(address: str) -> bool:
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return False
    return True


def _object(message: ElementTree.Element, object_id: str, entry: Mapping[str, Any] | None) -> None:
    kind = KINDS.get(object_id.partition("_")[0], "service")
    role = {"key": _SECURITY_USER, "project": _SECURITY_RESOURCE, "share": _SECURITY_RESOURCE}.get(kind, _REPORT)
    found = ElementTree.SubElement(
        message,
        "ParticipantObjectIdentification",
        ParticipantObjectID=object_id,
        ParticipantObjectTypeCode="2",
        ParticipantObjectTypeCodeRole=_SECURITY_RESOURCE if kind == "service" else role,
    )
    _coded(found, "ParticipantObjectIDTypeCode", Code(kind, f"Specimap {kind} id", SYSTEM))
    if entry is None:
        return
    details = {
        "seq": entry["seq"],
        "hash": entry["hash"],
        "count": entry["count"],
        "correlation_id": entry["correlation_id"],
        "project_id": entry["project_id"],
        "details": json_text(entry["details"], sort_keys=True),
    }
    for name, value in details.items():
        text = base64.b64encode(str(value).encode()).decode()
        ElementTree.SubElement(found, "ParticipantObjectDetail", type=name, value=text)

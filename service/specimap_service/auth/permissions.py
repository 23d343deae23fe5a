"""Who may do what: the one table of permissions.

An operation asks for one permission, by its operation id. A person has permissions by roles, a key by scopes. A new
operation needs a line in ``OPERATIONS``; without one it is refused to everybody.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from specimap_infra.tables import SCOPES

READ: Final = "result.read"
CAPTURE: Final = "capture.write"
RUN: Final = "job.run"
URGENT: Final = "job.urgent"
SHARE: Final = "share.manage"
LABEL: Final = "label.write"
DELETE: Final = "object.delete"
STUDY: Final = "study.manage"
SEND: Final = "result.send"
HOLD: Final = "hold.manage"
ERASE: Final = "specimen.erase"
AUDIT: Final = "audit.read"
AUDIT_ALL: Final = "audit.all"
KEYS: Final = "key.manage"
PROJECTS: Final = "project.manage"
WATCH: Final = "service.watch"
ALL_PROJECTS: Final = "project.all"

MEANINGS: dict[str, str] = {
    READ: "see acquisitions, files, jobs, results and labels; make and fetch exports",
    CAPTURE: "create acquisitions, upload files, take files out again",
    RUN: "start, repeat and cancel jobs; send their webhooks again",
    URGENT: "give a job the place of theatre in the queue",
    SHARE: "make, list and revoke links that show one result",
    LABEL: "write and delete label layers",
    DELETE: "delete acquisitions and jobs with all that belongs to them",
    STUDY: "see and change whose a specimen is: look orders up, keep study contexts, fetch DICOM objects",
    SEND: "have results sent to the archive and to the FHIR server",
    HOLD: "keep acquisitions from being deleted",
    ERASE: "erase all acquisitions of a specimen, of all projects",
    AUDIT: "read the audit trail",
    AUDIT_ALL: "read the audit trail of all projects, and what is of none",
    KEYS: "create, list and revoke keys",
    PROJECTS: "create and rename projects",
    WATCH: "read the metrics",
    ALL_PROJECTS: "see and use the objects of all projects",
}
"""Every permission, and what it permits within the projects that are seen."""
EVERYTHING = frozenset(MEANINGS)

ROLES: dict[str, frozenset[str]] = {
    "technician": frozenset({READ, CAPTURE, RUN, URGENT, STUDY, SEND}),
    "clinician": frozenset({READ, SHARE, LABEL, STUDY, SEND}),
    "classifier": frozenset({READ, LABEL}),
    "admin": EVERYTHING,
    "auditor": frozenset({AUDIT, AUDIT_ALL}),
}
"""What a person of a role may."""

SCOPE_PERMISSIONS: dict[str, frozenset[str]] = {
    "upload": frozenset({CAPTURE, RUN, SHARE, STUDY, SEND}),
    "read": frozenset({READ}),
    "label": frozenset({LABEL}),
    "intraoperative": frozenset({URGENT}),
    "audit": frozenset({AUDIT}),
    "admin": EVERYTHING,
}
"""What a key with a scope may."""

EQUIVALENT: dict[str, tuple[str, ...]] = {
    "technician": ("upload", "read", "intraoperative"),
    "clinician": ("read", "label"),
    "classifier": ("read", "label"),
    "admin": ("admin",),
    "auditor": ("audit",),
}
"""Scopes of a key for a program that does the work of a role. They differ in what goes beyond: ``share.manage`` and
``study.manage`` come with ``upload``, and ``audit.all`` with ``admin`` alone."""

OPERATIONS: dict[str, str | None] = {
    "acquisitions.create": CAPTURE,
    "acquisitions.delete": DELETE,
    "acquisitions.get": READ,
    "acquisitions.get_viewpoints": READ,
    "acquisitions.list": READ,
    "audit.list": AUDIT,
    "clouds.get": READ,
    "clouds.get_cameras": READ,
    "clouds.get_corners": READ,
    "clouds.list": READ,
    "deliveries.create": RUN,
    "deliveries.list": READ,
    "dicom.create": SEND,
    "dicom.get_archive": STUDY,
    "dicom.list": READ,
    # By object: photos need one permission, segmentations another.
    "dicomweb.create": None,
    "erasures.create": ERASE,
    "erasures.list": ERASE,
    "exports.create": READ,
    "exports.get": READ,
    "exports.get_content": READ,
    "exports.head_content": READ,
    "exports.list": READ,
    "fhir.get": READ,
    "fhir.create": SEND,
    "files.create": CAPTURE,
    "files.delete": CAPTURE,
    "files.get": READ,
    "files.get_content": READ,
    "files.list": READ,
    "health.get_metrics": WATCH,
    "holds.delete": HOLD,
    "holds.get": HOLD,
    "holds.put": HOLD,
    "jobs.cancel": RUN,
    "jobs.create": RUN,
    "jobs.delete": DELETE,
    "jobs.follow_events": READ,
    "jobs.get": READ,
    "jobs.get_log": READ,
    "jobs.get_report": READ,
    "jobs.list": READ,
    "jobs.rerun": RUN,
    "keys.create": KEYS,
    "keys.list": KEYS,
    "keys.revoke": KEYS,
    "labels.delete": LABEL,
    "labels.get": READ,
    "labels.get_values": READ,
    "labels.list": READ,
    "labels.list_versions": READ,
    "labels.put": LABEL,
    "orders.select": STUDY,
    "previews.get_band": READ,
    "previews.get_composite": READ,
    "previews.get_index": READ,
    "previews.get_label": READ,
    "previews.get_pca": READ,
    "previews.get_rgb": READ,
    "projects.create": PROJECTS,
    "projects.get": READ,
    "projects.list": READ,
    "projects.update": PROJECTS,
    # Whoever is known may ask who that is, and sign out.
    "sessions.delete": None,
    "sessions.get": None,
    "shares.create": SHARE,
    "shares.list": SHARE,
    "shares.revoke": SHARE,
    "spectra.get_band": READ,
    "spectra.get_point": READ,
    "spectra.select": READ,
    "sso.end": None,
    "studies.delete": STUDY,
    "studies.get": STUDY,
    "studies.put": STUDY,
    "uploads.append": CAPTURE,
    "uploads.create": CAPTURE,
    "uploads.delete": CAPTURE,
    "uploads.get_offset": CAPTURE,
    "uploads.get_options": CAPTURE,
    "uploads.get_result": CAPTURE,
    "zarr.get": READ,
    "zarr.head": READ,
}
"""The permission that each operation asks for, by operation id; None where every key, person and share will do."""


def of_roles(roles: Iterable[str]) -> frozenset[str]:
    """Return what a person with these roles may; a role that is no longer known permits nothing."""
    return frozenset().union(*(ROLES.get(role, frozenset()) for role in roles))


def of_scopes(scopes: Iterable[str]) -> frozenset[str]:
    """Return what a key with these scopes may."""
    return frozenset().union(*(SCOPE_PERMISSIONS.get(scope, frozenset()) for scope in scopes))


def scopes_within(permissions: frozenset[str]) -> list[str]:
    """Return the scopes of which every permission is among these."""
    return [scope for scope in SCOPES if SCOPE_PERMISSIONS[scope] <= permissions]


def scope_for(permission: str) -> str:
    """Return the smallest scope that has a permission."""
    found = [scope for scope in SCOPES if permission in SCOPE_PERMISSIONS[scope]]
    return min(found, key=lambda scope: len(SCOPE_PERMISSIONS[scope]))


def roles_for(permission: str) -> list[str]:
    """Return the roles that have a permission."""
    return [role for role, held in ROLES.items() if permission in held]

"""Which event of DICOM PS3.15 each action of the audit trail is."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Code:
    """A coded value of DICOM's own code system, DCM."""

    value: str
    meaning: str
    system: str = "DCM"


@dataclass(frozen=True)
class Event:
    """An event: its identifier (CID 400), its types (CID 401) and its action: C, R, U, D or E."""

    id: Code
    action: str
    types: tuple[Code, ...] = ()


APPLICATION_ACTIVITY = Code("110100", "Application Activity")
AUDIT_LOG_USED = Code("110101", "Audit Log Used")
INSTANCES_ACCESSED = Code("110103", "DICOM Instances Accessed")
INSTANCES_TRANSFERRED = Code("110104", "DICOM Instances Transferred")
STUDY_DELETED = Code("110105", "DICOM Study Deleted")
EXPORT = Code("110106", "Export")
IMPORT = Code("110107", "Import")
ORDER_RECORD = Code("110109", "Order Record")
PATIENT_RECORD = Code("110110", "Patient Record")
QUERY = Code("110112", "Query")
SECURITY_ALERT = Code("110113", "Security Alert")
USER_AUTHENTICATION = Code("110114", "User Authentication")
START, STOP = Code("110120", "Application Start"), Code("110121", "Application Stop")
LOGIN, LOGOUT = Code("110122", "Login"), Code("110123", "Logout")
SECURITY_CONFIGURATION = Code("110129", "Security Configuration")
OBJECT_SECURITY = Code("110135", "Object Security Attributes Changed")
USER_SECURITY = Code("110137", "User Security Attributes Changed")

_EXACT = {
    "service.start": Event(APPLICATION_ACTIVITY, "E", (START,)),
    "service.stop": Event(APPLICATION_ACTIVITY, "E", (STOP,)),
    "session.create": Event(USER_AUTHENTICATION, "E", (LOGIN,)),
    "share.open": Event(USER_AUTHENTICATION, "E", (LOGIN,)),
    "session.delete": Event(USER_AUTHENTICATION, "E", (LOGOUT,)),
    "audit.prune": Event(AUDIT_LOG_USED, "D"),
    "acquisition.delete": Event(STUDY_DELETED, "D"),
    "acquisition.erase": Event(STUDY_DELETED, "D"),
    "acquisition.expire": Event(STUDY_DELETED, "D"),
    "exports.get_content": Event(EXPORT, "R"),
}
_FIRST = {
    "audit": (AUDIT_LOG_USED, ()),
    "session": (USER_AUTHENTICATION, (LOGIN,)),
    "sessions": (USER_AUTHENTICATION, (LOGIN,)),
    "key": (SECURITY_ALERT, (USER_SECURITY,)),
    "keys": (SECURITY_ALERT, (USER_SECURITY,)),
    "person": (SECURITY_ALERT, (USER_SECURITY,)),
    "role": (SECURITY_ALERT, (USER_SECURITY,)),
    "project": (SECURITY_ALERT, (SECURITY_CONFIGURATION,)),
    "retention": (SECURITY_ALERT, (SECURITY_CONFIGURATION,)),
    "share": (SECURITY_ALERT, (OBJECT_SECURITY,)),
    "shares": (SECURITY_ALERT, (OBJECT_SECURITY,)),
    "hold": (SECURITY_ALERT, (OBJECT_SECURITY,)),
    "export": (EXPORT, ()),
    "upload": (IMPORT, ()),
    "uploads": (IMPORT, ()),
    "file": (IMPORT, ()),
    "order": (ORDER_RECORD, ()),
    "orders": (ORDER_RECORD, ()),
    "study": (PATIENT_RECORD, ()),
    "studies": (PATIENT_RECORD, ()),
    "holds": (SECURITY_ALERT, (OBJECT_SECURITY,)),
    "projects": (SECURITY_ALERT, (SECURITY_CONFIGURATION,)),
    "erasures": (STUDY_DELETED, ()),
    "dicomweb": (IMPORT, ()),
    "fhir": (EXPORT, ()),
    "dicom": (INSTANCES_TRANSFERRED, ()),
    "delivery": (INSTANCES_TRANSFERRED, ()),
}
"""By the first part of an action."""
_VERBS = {
    **dict.fromkeys(("create", "put", "import"), "C"),
    **dict.fromkeys(("update", "rename", "append", "set"), "U"),
    **dict.fromkeys(("delete", "revoke", "terminate", "expire", "erase", "prune", "release"), "D"),
    **dict.fromkeys(("cancel", "run", "rerun", "notify", "select", "list"), "E"),
}


def event_of(action: str, status: int | None = None) -> Event:
    """Return the event that an action is; ``status``: HTTP status of the answer."""
    if status == 401:
        return Event(USER_AUTHENTICATION, "E", (LOGIN,))
    if action in _EXACT:
        return _EXACT[action]
    first, _, verb = action.partition(".")
    if (verb == "list" and first != "audit") or action in ("order.search", "orders.select"):
        return Event(QUERY, "E")
    code, types = _FIRST.get(first, (INSTANCES_ACCESSED, ()))
    if action.startswith(("files.", "exports.")) and verb.startswith("get"):
        code = INSTANCES_ACCESSED
    action_code = _VERBS.get(verb, "R")
    if code is AUDIT_LOG_USED:
        action_code = "R"
    return Event(code, action_code, types)

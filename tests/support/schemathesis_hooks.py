"""How generated bodies of binary media types are sent, and which requests that fit the contract may be refused."""

from __future__ import annotations

import re
from typing import Any

import schemathesis
from schemathesis.specs.openapi.checks import positive_data_acceptance


@schemathesis.serializer(
    'multipart/related; type="application/dicom"',
    "multipart/related",
    "application/vnd.apache.arrow.stream",
    "application/x-npy",
    "application/offset+octet-stream",
)
def raw(context: schemathesis.SerializationContext, value: Any) -> Any:
    """Bytes as they are, anything else as text."""
    return value if isinstance(value, bytes) else str(value).encode()


REASONS: dict[str, tuple[str, ...]] = {
    # What depends on the result, on the service's settings, or on two parameters, is in no schema.
    "spectra.select": (r"low is at most high", r"distance_mm goes with", r"There is no (point|band)"),
    "spectra.get_band": (r"There is no band",),
    "previews.get_band": (r"Which band is not said, or said twice", r"low and high are no range"),
    "previews.get_composite": (r"low and high are no range",),
    "previews.get_index": (r"low and high are no range",),
    "previews.get_label": (r"low and high are no range",),
    "jobs.create": (r"The webhook's host is not one",),
    "jobs.rerun": (r"The webhook's host is not one",),
    "orders.select": (r"give an accession number",),
    "dicom.create": (r"not both", r"columns are those"),
    "keys.create": (r"the time has passed", r"none of them a control character"),
    "shares.create": (r"the time has passed", r"days from now", r"none of them a control character"),
    "uploads.create": (r"Upload-Metadata names no (role|acquisition)",),
    "labels.put": (r"The body is not an Arrow IPC stream", r"The body is no npy"),
}
"""For each operation: why it may refuse a request that fits the contract, besides what is missing or in conflict."""


@schemathesis.check
def refused_for_a_known_reason(context: Any, response: Any, case: Any) -> bool | None:
    """As the check ``positive_data_acceptance``, of which this is the stricter part: a reason has to be known."""
    try:
        return positive_data_acceptance(context, response, case)
    except AssertionError:
        known = REASONS.get(case.operation.definition.raw.get("operationId", ""), ())
        if any(re.search(reason, response.json()["detail"]) for reason in known):
            return None
        raise

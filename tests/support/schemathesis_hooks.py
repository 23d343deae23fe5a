"""How generated bodies of binary media types are sent."""

from __future__ import annotations

from typing import Any

import schemathesis


@schemathesis.serializer("application/vnd.apache.arrow.stream", "application/x-npy", "application/offset+octet-stream")
def raw(context: schemathesis.SerializationContext, value: Any) -> Any:
    """Bytes as they are, anything else as text."""
    return value if isinstance(value, bytes) else str(value).encode()

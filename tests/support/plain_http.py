"""HTTP without TLS, which is all that tests speak to a service of their own."""

from __future__ import annotations

import ssl

NO_TLS = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
"""For ``verify``: trusts nobody. Without it, each client reads all of the system's certificates, which takes 0.1 s."""

"""An S3 endpoint for tests: moto's server on a free port."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import httpx
from moto.server import ThreadedMotoServer

from tests.support.plain_http import NO_TLS


@contextmanager
def object_store(bucket: str) -> Iterator[str]:
    """URL of an S3-compatible store with an empty bucket."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    try:
        httpx.put(f"{endpoint}/{bucket}", trust_env=False, verify=NO_TLS).raise_for_status()
        yield endpoint
    finally:
        server.stop()

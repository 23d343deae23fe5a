"""The HTTP server's own settings."""

from __future__ import annotations

import gc
import math
import socket
from typing import Any

import uvicorn
from fastapi import FastAPI

from specimap_infra.settings import ServiceSettings
from specimap_service.connections import connections_within

PROBES = {"TCP_KEEPIDLE": 60, "TCP_KEEPINTVL": 15, "TCP_KEEPCNT": 4}


def server_config(app: FastAPI, settings: ServiceSettings, **given: Any) -> uvicorn.Config:
    """Describe a server of the app to uvicorn; ``given`` are further values."""
    return uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        ws="none",
        lifespan="on",
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=5,
        timeout_keep_alive=math.ceil(settings.keep_alive_seconds),
        http=connections_within(settings),
        **given,
    )


def notice_dead_peers(listener: socket.socket, seconds: float) -> None:
    """End connections to machines that vanished: within ``seconds`` where bytes are under way, else in two minutes.

    Accepted connections inherit this from their listening socket.
    """
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in {**PROBES, "TCP_USER_TIMEOUT": int(seconds * 1000)}.items():
        if hasattr(socket, name):  # Linux has all of them
            listener.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def keep_collections_short() -> None:
    """Leave all that lives by now out of garbage collections: call it once, when the process has started.

    The app, its schemas and its libraries live as long as the process, and a full collection looks at all of them:
    0.15 s in which no request is answered, every few hundred requests for long lists.
    """
    gc.collect()
    gc.freeze()

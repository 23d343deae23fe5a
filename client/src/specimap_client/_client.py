"""The client."""

from __future__ import annotations

import os
import ssl
from types import TracebackType
from typing import Self

import httpx

from specimap_client._acquisitions import Acquisitions
from specimap_client._clouds import Clouds
from specimap_client._errors import NotConfigured
from specimap_client._http import Session
from specimap_client._jobs import Jobs
from specimap_client._keys import Keys
from specimap_client._projects import Projects
from specimap_client._retries import Retries

URL_VARIABLE, KEY_VARIABLE = "SPECIMAP_URL", "SPECIMAP_KEY"
TIMEOUT = httpx.Timeout(60.0, connect=10.0)


class Client:
    """A service, and a key to it. A context manager; safe to share between threads.

    ``url`` and ``key`` come from ``SPECIMAP_URL`` and ``SPECIMAP_KEY`` where they are not given. ``timeout``: seconds
    of silence after which an attempt counts as failed. ``verify``: an :class:`ssl.SSLContext` for a hospital's own
    certificates (``SSL_CERT_FILE`` works too). ``correlation_id`` marks all requests in the service's log; without it
    each call gets one of its own. ``transport``: of httpx, for tests or unusual networks.

    Raises:
        NotConfigured: there is no address, or one that cannot be.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: httpx.Timeout | float = TIMEOUT,
        retries: Retries | None = None,
        verify: ssl.SSLContext | bool = True,
        correlation_id: str | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        url = url or os.environ.get(URL_VARIABLE)
        key = (key or os.environ.get(KEY_VARIABLE, "")).strip()
        if not url:
            raise NotConfigured(f"There is no address. Give url, or set {URL_VARIABLE}.")
        self._session = Session(
            url,
            key or None,
            timeout=timeout,
            retries=retries or Retries(),
            transport=transport,
            verify=verify,
            correlation_id=correlation_id,
        )
        self.acquisitions = Acquisitions(self._session)
        self.jobs = Jobs(self._session)
        self.clouds = Clouds(self._session)
        self.keys = Keys(self._session)
        self.projects = Projects(self._session)

    @property
    def url(self) -> str:
        """The service's address."""
        return self._session.url

    @property
    def correlation_id(self) -> str:
        """Of the latest answer: it finds the request in the service's log. Empty before the first."""
        return self._session.correlation_id

    def close(self) -> None:
        """Close the connections."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Client of {self.url}>"

"""How many connections there may be: in all, of one address, and within the files that the process may have open."""

from __future__ import annotations

import resource
from collections import Counter
from typing import Protocol

from specimap_infra.logs import logger

FILES_PER_CONNECTION = 2
"""Its socket, and the stored file that an answer reads."""
OTHER_FILES = 256
"""Open files apart from connections: the database, the queue, clouds, judging."""
REFUSED_TOGETHER = 64
"""Refused connections that are kept for a moment, so that the client surely sees why; further ones are closed."""


class Client(Protocol):
    """A connection as the admission sees it."""

    def give_way(self) -> None:
        """Close: nothing is under way, and another connection needs the place."""


class Admission:
    """Places for connections. Used on one event loop.

    A connection without a request under way gives its place to a new one if there is no other: who holds connections
    without using them keeps nobody out.
    """

    def __init__(self, most: int, most_per_address: int) -> None:
        self._most, self._most_per_address = most, most_per_address
        self._addresses: dict[Client, str] = {}
        self._counts: Counter[str] = Counter()
        self._waiting: dict[Client, None] = {}
        self._refused: set[Client] = set()
        self._told = False

    def admit(self, client: Client, address: str) -> bool:
        """Give a place to a connection that has no request yet; return False if there is none."""
        if self._counts[address] >= self._most_per_address:
            fits = self._make_room(address)
        else:
            fits = len(self._addresses) < self._most or self._make_room(None)
        if not fits:
            if not self._told:
                logger().warning("connections are refused", open=len(self._addresses))
            self._told = True
            return False
        self._addresses[client] = address
        self._counts[address] += 1
        self._waiting[client] = None
        return True

    def may_be_told(self, client: Client) -> bool:
        """Return whether a refused connection may stay for a moment to be told so."""
        if len(self._refused) >= REFUSED_TOGETHER:
            return False
        self._refused.add(client)
        return True

    def set_waiting(self, client: Client, waiting: bool) -> None:
        """Note whether a connection waits for a request, or has one under way."""
        if not waiting:
            self._waiting.pop(client, None)
        elif client in self._addresses:
            self._waiting.setdefault(client)

    def leave(self, client: Client) -> None:
        """Free the place of a connection, if it has one."""
        self._refused.discard(client)
        self._waiting.pop(client, None)
        address = self._addresses.pop(client, None)
        if address is None:
            return
        self._counts[address] -= 1
        if not self._counts[address]:
            del self._counts[address]
        # The next shortage is logged anew, not each connection of this one.
        self._told = self._told and len(self._addresses) > self._most // 2

    def _make_room(self, address: str | None) -> bool:
        """Close the connection that has waited longest, of one address or of all."""
        found = next((c for c in self._waiting if address is None or self._addresses[c] == address), None)
        if found is None:
            return False
        self.leave(found)
        found.give_way()
        return True


def fit_open_files(most: int) -> int:
    """Raise the process's limit of open files to what ``most`` connections need; return how many the limit allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = most * FILES_PER_CONNECTION + OTHER_FILES
    allowed = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    if allowed == needed:
        return most
    fitting = max(16, (allowed - OTHER_FILES) // FILES_PER_CONNECTION)
    logger().warning("fewer connections than set: the limit of open files is low", open_files=hard, fitting=fitting)
    return min(most, fitting)

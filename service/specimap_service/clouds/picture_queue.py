"""Pictures that wait to be drawn: a queue that is fair between keys, before a few drawing processes."""

from __future__ import annotations

from anyio import BrokenWorkerProcess, CapacityLimiter, to_process

from specimap_core.errors import BackendUnavailableError
from specimap_infra.settings import ServiceSettings
from specimap_service.clouds.drawing import Drawing, draw
from specimap_service.clouds.picture_cache import PictureCache
from specimap_service.clouds.pictures import Picture
from specimap_service.fair_turns import FairTurns, TurnBounds

DRAWN = TurnBounds(at_once=3, of_key=2, waiting=128, waiting_of_key=32)
"""Each takes up to some hundred megabytes of memory meanwhile, and a process that stays for the next one."""


class PictureQueue:
    """The pictures of one app, drawn in processes that are started when first needed."""

    def __init__(self, settings: ServiceSettings) -> None:
        self.cache = PictureCache()
        self._settings = settings
        self._turns = FairTurns(DRAWN)
        self._processes = CapacityLimiter(DRAWN.at_once)

    async def picture(self, key: str, tag: str, drawing: Drawing) -> Picture:
        """Return the picture of a tag, drawn if it is not cached.

        Raises:
            TooManyAtOnceError, OverloadedError: too many wait.
            BackendUnavailableError: the process ended before the picture was there.
            RequestInvalidError, NotFoundError, CloudDamagedError, StorageUnavailableError: as :func:`draw`.
        """
        found = self.cache.find(tag)
        if found is not None:
            return found
        async with self._turns.turn_async(key):
            # Another request may have drawn it while this one waited.
            found = self.cache.find(tag)
            if found is None:
                try:
                    found = await to_process.run_sync(
                        draw, self._settings, drawing, cancellable=True, limiter=self._processes
                    )
                except BrokenWorkerProcess as error:
                    raise BackendUnavailableError(
                        "The process that draws pictures ended before this one was there.",
                        advice="Ask again; if that does not help, the machine lacks memory.",
                    ) from error
                self.cache.keep(tag, found)
        return found

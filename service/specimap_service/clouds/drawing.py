"""What a drawing process does: open a cloud, colour its points, draw the picture. It loads no web framework.

Drawing takes the processor for up to seconds, and the interpreter with it: in processes of their own, behind those that
answer requests, it holds up none of them.
"""

from __future__ import annotations

import signal
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from specimap_core.cloud import Cloud
from specimap_core.cloud.shards import PointArray
from specimap_core.errors import CloudDamagedError, NotFoundError
from specimap_core.threads import step_back
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_service.clouds import pictures
from specimap_service.clouds.pictures import Grid, Picture, PointColours
from specimap_service.clouds.stored_folder import StoredFolder

MOST_CLOUDS = 4
MOST_BYTES = 256 * 1024**2
"""Clouds that a process keeps open for the next picture, and their memory; the one in use is kept in any case."""


@dataclass(frozen=True)
class Canvas:
    """An open cloud, and the folder of its job's result in the storage."""

    cloud: Cloud
    storage: Storage
    prefix: str


Paint = Callable[[Canvas], PointColours]
"""Something that a process can be told: a function of this module, or a :func:`functools.partial` of one."""


@dataclass(frozen=True)
class Drawing:
    """A picture that is wanted of the cloud in ``prefix``, the folder of its job's result."""

    prefix: str
    paint: Paint
    grid: Grid
    size: int


def draw(settings: ServiceSettings, drawing: Drawing) -> Picture:
    """Draw a picture, in a process of its own.

    Raises:
        RequestInvalidError, NotFoundError: there is no such band.
        CloudDamagedError, StorageUnavailableError: the cloud cannot be read.
    """
    settle()
    canvas = opened(settings, drawing.prefix)
    try:
        return pictures.draw(canvas.cloud, drawing.paint(canvas), drawing.grid, drawing.size)
    except CloudDamagedError:
        _OPENED.clear()
        raise


# ---- what is painted ----------------------------------------------------------------------------------


def rgb(canvas: Canvas) -> PointColours:
    """Colour points as the photos do."""
    return pictures.paint_rgb(canvas.cloud)


def pca(canvas: Canvas) -> PointColours:
    """Colour points as the run's own preview does."""
    return pictures.paint_pca(canvas.cloud, canvas.storage.read(f"{canvas.prefix}/preview.png"))


def band(canvas: Canvas, given: str, limits: tuple[float, float] | None) -> PointColours:
    """Show a band, which is an index or a wavelength, in grey."""
    return pictures.paint_band(canvas.cloud, pictures.band_index(canvas.cloud, given), limits)


def composite(canvas: Canvas, given: tuple[str, str, str]) -> PointColours:
    """Show three bands as red, green and blue."""
    red, green, blue = (pictures.band_index(canvas.cloud, name) for name in given)
    return pictures.paint_composite(canvas.cloud, (red, green, blue))


def index(canvas: Canvas, given: tuple[str, str], limits: tuple[float, float] | None) -> PointColours:
    """Show the normalised difference of two bands as a colour scale."""
    first, second = (pictures.band_index(canvas.cloud, name) for name in given)
    return pictures.paint_index(canvas.cloud, first, second, limits)


def classes(canvas: Canvas, prefix: str, known: list[dict[str, Any]]) -> PointColours:
    """Show the classes of a label in their colours."""
    return pictures.paint_classes(canvas.cloud, _label(canvas, prefix), known)


def probability(canvas: Canvas, prefix: str, column: int, limits: tuple[float, float] | None) -> PointColours:
    """Show one class's probabilities of a label as a colour scale."""
    values = _label(canvas, prefix)
    return pictures.paint_probability(canvas.cloud, values.reshape(len(values), -1)[:, column], limits)


def _label(canvas: Canvas, prefix: str) -> Any:
    folder, _, name = prefix.rpartition("/")
    path = canvas.storage.path(folder)
    array = PointArray(StoredFolder(canvas.storage, folder) if path is None else path, name)
    return array.read(0, array.shape[0])


# ---- what the process keeps ---------------------------------------------------------------------------

_OPENED: OrderedDict[tuple[str, str], Canvas] = OrderedDict()
_STORAGES: dict[str, Storage] = {}


@cache
def settle() -> None:
    """Give way to the processes that answer requests, and leave the terminal's interrupt to them."""
    step_back()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def opened(settings: ServiceSettings, prefix: str) -> Canvas:
    place = settings.storage_place
    found = _OPENED.pop((place, prefix), None)
    if found is None:
        if place not in _STORAGES:
            _STORAGES[place] = Storage.open(settings)
        storage, folder = _STORAGES[place], f"{prefix}/cloud.zarr"
        path = storage.path(folder)
        try:
            cloud = Cloud.open(StoredFolder(storage, folder) if path is None else path)
        except NotFoundError as error:
            raise CloudDamagedError("The cloud's files are gone.", advice="") from error
        found = Canvas(cloud, storage, prefix)
    _OPENED[place, prefix] = found
    while len(_OPENED) > 1 and (
        len(_OPENED) > MOST_CLOUDS or sum(kept.cloud.kept_bytes for kept in _OPENED.values()) > MOST_BYTES
    ):
        _OPENED.popitem(last=False)
    return found

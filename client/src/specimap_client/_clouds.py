"""Clouds: points with spectra, read over HTTP, and labels written back."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from specimap_client import _exports, _labels, _shares, _spectra_answers
from specimap_client._decode import Model
from specimap_client._downloads import fetch_zarr
from specimap_client._errors import MissingExtra
from specimap_client._http import Session, path
from specimap_client._labels import ClassLike, Label
from specimap_client._models import Acquisition, Export, Point, Progress, Project, id_of
from specimap_client._spectra import Selection, Spectra, query

if TYPE_CHECKING:
    import xarray
    import zarr

Number = TypeVar("Number", bound=np.generic)
PAGE = 10_000
"""Points of a request for spectra: 8 MB at 200 bands."""


@dataclass(frozen=True, kw_only=True)
class _Summary(Model):
    id: str
    job_id: str
    acquisition_id: str
    points: int
    bands: int
    size: int
    created_at: datetime.datetime


@dataclass(frozen=True, kw_only=True)
class _Details(Model):
    quantity: str
    wavelength_nm: tuple[float | None, ...]
    bad_bands: tuple[int, ...]


class Cloud:
    """A finished result. S points, B bands; lengths in mm, in the marker frame.

    ``id``, ``job_id``, ``acquisition_id``, ``points`` (S), ``bands`` (B), ``size`` in bytes, ``created_at``. What is
    read on first use is kept.
    """

    def __init__(self, session: Session, data: object) -> None:
        summary = _Summary.of(data)
        self._session = session
        self._data = data
        self.id = summary.id
        self.job_id = summary.job_id
        self.acquisition_id = summary.acquisition_id
        self.points = summary.points
        self.bands = summary.bands
        self.size = summary.size
        self.created_at = summary.created_at

    @cached_property
    def _details(self) -> _Details:
        # Lists of clouds leave them out.
        if isinstance(self._data, dict) and "wavelength_nm" in self._data:
            return _Details.of(self._data)
        return _Details.of(self._session.json("GET", path("clouds", self.id)))

    @cached_property
    def wavelength_nm(self) -> NDArray[np.float32]:
        """(B,), NaN where unknown."""
        return np.array([np.nan if nm is None else nm for nm in self._details.wavelength_nm], np.float32)

    @property
    def quantity(self) -> str:
        """What spectra are: ``reflectance``, or ``counts`` where the cube had no reference."""
        return self._details.quantity

    @cached_property
    def good_bands(self) -> NDArray[np.intp]:
        """Numbers of the bands that neither the cube's file nor their noise declares useless."""
        return np.setdiff1d(np.arange(self.bands), np.array(self._details.bad_bands, np.intp))

    def __repr__(self) -> str:
        return f"<Cloud {self.id}: {self.points} points, {self.bands} bands>"

    # ---- spectra ----------------------------------------------------------------------------------------

    def spectra(self, **selection: Unpack[Selection]) -> Spectra:
        """Spectra of a selection, all of them in memory.

        One of ``indices``, ``pixels`` [(row, column), ...], ``polygon`` [(row, column), ...], ``box`` (low, high),
        ``radius`` (centre, mm), ``nearest`` (place, k). Bands by ``nm`` (from, to) or ``bands`` numbers; without
        them all. ``fields`` of the points, such as ``("xyz", "flags")``, come along. NaN where a point has no value.

        Raises:
            ValueError: that is not exactly one selection.
            Refused: the service does not take it.
        """
        asked = query(self.wavelength_nm, selection)
        return _spectra_answers.gathered(list(_spectra_answers.pages(self._session, self.id, asked, PAGE)), asked)

    def iter_spectra(self, *, page: int = PAGE, **selection: Unpack[Selection]) -> Iterator[Spectra]:
        """As :meth:`spectra`, in pages of at most ``page`` points, each asked for when it is reached."""
        asked = query(self.wavelength_nm, selection)
        return _spectra_answers.pages(self._session, self.id, asked, page)

    def point(self, index: int) -> Point:
        """All that is known of one point."""
        return Point.of(self._session.json("GET", path("clouds", self.id, "points", index)))

    def band(self, band: int) -> NDArray[np.float32]:
        """One band of all points, (S,); NaN where a point has no value."""
        headers = {"Accept": _spectra_answers.NPY}
        answer = self._session.request("GET", path("clouds", self.id, "bands", band), headers=headers)
        return _spectra_answers.npy_of(answer).astype(np.float32, copy=False).reshape(-1)

    # ---- arrays of all points ---------------------------------------------------------------------------

    @cached_property
    def xyz(self) -> NDArray[np.float32]:
        """(S, 3) mm. This and the following need the extra ``zarr``."""
        return self._array("xyz", np.float32)

    @cached_property
    def normal(self) -> NDArray[np.float32]:
        """(S, 3) unit vectors."""
        return self._array("normal", np.float32)

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """(S, 3) from the photos."""
        return self._array("rgb", np.uint8)

    @cached_property
    def hsi_pixel(self) -> NDArray[np.uint16]:
        """(S, 2) row, column in the cube."""
        return self._array("hsi_pixel", np.uint16)

    @cached_property
    def sigma_mm(self) -> NDArray[np.float32]:
        """(S,) one standard deviation of the position."""
        return self._array("sigma_mm", np.float32)

    @cached_property
    def flags(self) -> NDArray[np.uint8]:
        """(S,) bits: 1 specimen, 2 marker card, 4 grazing, 8 saturated, 16 depth interpolated, 32 occluded,
        64 undercut, 128 no data (a good band has no value)."""
        return self._array("flags", np.uint8)

    def zarr(self) -> zarr.Group:
        """The cloud as a read-only group over HTTP; ``["spectra"]`` is stored, not decoded. Needs ``zarr``."""
        try:
            import zarr
        except ImportError as error:
            raise MissingExtra("zarr", "zarr") from error
        return zarr.open_group(self._store(), mode="r", zarr_format=3, use_consolidated=True)

    def xarray(self) -> xarray.Dataset:
        """The cloud as a lazy dataset with the dimensions ``point`` and ``band``, decoded. Needs ``xarray``."""
        try:
            import xarray
        except ImportError as error:
            raise MissingExtra("xarray", "xarray") from error
        found = xarray.open_dataset(self._store(), engine="zarr", consolidated=True, chunks=None)
        return found.set_coords("wavelength_nm")

    def _array(self, name: str, kind: type[Number]) -> NDArray[Number]:
        return np.asarray(self.zarr()[name][...], kind)  # type: ignore[index]

    def _store(self) -> Any:
        try:
            from specimap_client._zarr import CloudStore
        except ImportError as error:
            raise MissingExtra("zarr", "zarr") from error
        return CloudStore(self._session, self.id)

    # ---- files ------------------------------------------------------------------------------------------

    def download(self, target: str | PathLike[str], *, progress: Callable[[Progress], None] | None = None) -> Path:
        """The whole group, labels too, as the new folder ``target``; called again, it goes on where it stopped.

        Raises:
            FileExistsError: there is something at ``target``.
        """
        place = Path(target)

        def heard(done: int, total: int) -> None:
            if progress is not None:
                progress(Progress(place.name, done, total, done, total))

        return fetch_zarr(self._session, self.id, place, heard)

    def corners(self) -> bytes:
        """The marker corners, ``{"<id>": [[x, y, z] * 4]}`` in mm, as JSON."""
        return self._session.request("GET", path("clouds", self.id, "corners")).content

    def cameras(self) -> bytes:
        """Poses and lenses of the photos and of the cube, as JSON. Raises NotFound for results of early versions."""
        return self._session.request("GET", path("clouds", self.id, "cameras")).content

    def preview(self, kind: str = "rgb", **parameters: Any) -> bytes:
        """A PNG picture, ``size`` pixels at its longer side.

        ``kind`` is rgb, pca, band (b or nm), composite (r, g, b), index (a, b) or label (name).
        """
        return self._session.request(
            "GET", path("clouds", self.id, "previews", f"{kind}.png"), params=parameters
        ).content

    def export(
        self,
        format: _exports.Format,
        target: str | PathLike[str],
        *,
        timeout: float | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> Path:
        """Have a file made, wait for it, and write it to ``target``, resumed where the connection breaks.

        Raises:
            ExportFailed: it cannot be made.
            Timeout: it is not made in ``timeout`` seconds; it goes on.
        """
        export = _exports.wait(self._session, self.request_export(format), timeout)
        return _exports.download(self._session, export, Path(target), progress)

    def request_export(self, format: _exports.Format) -> Export:
        """Have a file made, without waiting; the same export is made once."""
        return _exports.request(self._session, self.id, format)

    def exports(self) -> list[Export]:
        """What was asked for."""
        found = self._session.json("GET", path("clouds", self.id, "exports"))
        return [Export.of(item) for item in found]

    # ---- shares -----------------------------------------------------------------------------------------

    def share(self, name: str, expires_at: datetime.datetime) -> _shares.NewShare:
        """A link that shows this result, and nothing else, to whoever has it. ``expires_at`` is aware; at most 90 days.

        ``name`` says who it is for; no patient's name.
        """
        return _shares.create(self._session, self.id, name, expires_at)

    def shares(self) -> list[_shares.Share]:
        """The links to this result, also those that have ended."""
        return _shares.list_all(self._session, self.id)

    def revoke_share(self, share: _shares.Share) -> None:
        """End a link; it shows nothing within two seconds."""
        _shares.revoke(self._session, share)

    # ---- labels -----------------------------------------------------------------------------------------

    def labels(self) -> list[Label]:
        """The current version of each layer."""
        found = self._session.json("GET", path("clouds", self.id, "labels"))
        return [_labels.bound(self._session, item) for item in found]

    def label(self, name: str, version: int | None = None) -> Label:
        """A layer: the current version, or the one of this number; ``values()`` reads it."""
        answer = self._session.json("GET", path("clouds", self.id, "labels", name), params={"version": version})
        return _labels.bound(self._session, answer)

    def put_label(
        self,
        name: str,
        values: ArrayLike,
        *,
        classes: Sequence[ClassLike] = (),
        made_by: Mapping[str, Any] | str,
        if_version: int | None = None,
    ) -> Label:
        """Write a layer: integers (S,) are classes, floats (S,) or (S, C) probabilities. A new version of its name.

        ``classes``: ``(value, name, "#rrggbb")``, for integers every value that occurs. ``made_by``: the model's or
        person's name, or a mapping with ``name`` and, say, ``version``. ``if_version``: only if that is still the
        current version; 0: only if there is none yet. The same content again is no new version.

        Raises:
            ValueError: the values do not fit the cloud.
            Conflict: another version has come meanwhile.
        """
        return _labels.put_label(self._session, self.id, self.points, name, values, classes, made_by, if_version)


class Clouds:
    """``client.clouds``."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def get(self, cloud: str) -> Cloud:
        """A cloud by its id, which a succeeded job has as ``cloud_id``."""
        return Cloud(self._session, self._session.json("GET", path("clouds", cloud)))

    def list(
        self,
        *,
        acquisition: Acquisition | str | None = None,
        specimen_id: str | None = None,
        project: Project | str | None = None,
    ) -> Iterator[Cloud]:
        """Clouds, newest first, page by page as they are reached. ``project``: as for acquisitions."""
        filters = {
            "acquisition_id": None if acquisition is None else id_of(acquisition),
            "project": None if project is None else id_of(project),
        }
        for item in self._session.pages(path("clouds"), specimen_id=specimen_id, **filters):
            yield Cloud(self._session, item)

"""Acquisitions: what was captured of one specimen, and its files."""

from __future__ import annotations

import builtins
import datetime
from collections.abc import Iterable, Iterator, Sequence

from specimap_client._errors import UnexpectedAnswer
from specimap_client._http import Session, path
from specimap_client._models import Acquisition, File, Project, id_of
from specimap_client._uploads import AnyPath, Listener, upload


class Acquisitions:
    """``client.acquisitions``. Where an acquisition is asked for, its id will do."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def create(
        self,
        specimen_id: str,
        *,
        accession_number: str | None = None,
        dictionary: str = "DICT_4X4_50",
        edge_mm: float = 6.8,
        notes: str = "",
    ) -> Acquisition:
        """A new acquisition. Not repeated after a lost answer: look into :meth:`list` for it first."""
        body = {
            "specimen_id": specimen_id,
            "accession_number": accession_number,
            "dictionary": dictionary,
            "edge_mm": edge_mm,
            "notes": notes,
        }
        return Acquisition.of(self._session.create(path("acquisitions"), body))

    def get(self, acquisition: Acquisition | str) -> Acquisition:
        """The acquisition as it is now."""
        return Acquisition.of(self._session.json("GET", path("acquisitions", id_of(acquisition))))

    def list(
        self,
        *,
        specimen_id: str | None = None,
        accession_number: str | None = None,
        created_after: datetime.datetime | None = None,
        created_before: datetime.datetime | None = None,
        project: Project | str | None = None,
    ) -> Iterator[Acquisition]:
        """Acquisitions, newest first, page by page as they are reached. Times are aware.

        ``project``: of what the key sees, only this one's; a text is its id or name.
        """
        owner = None if project is None else id_of(project)
        filters = {"specimen_id": specimen_id, "accession_number": accession_number, "project": owner}
        times = {
            name: time.astimezone(datetime.UTC).isoformat() if time else None
            for name, time in (("created_after", created_after), ("created_before", created_before))
        }
        for item in self._session.pages(path("acquisitions"), **filters, **times):
            yield Acquisition.of(item)

    def delete(self, acquisition: Acquisition | str) -> None:
        """Delete it with its files, jobs and results. Needs the scope ``admin``.

        Raises:
            Conflict: a job runs.
        """
        self._session.request("DELETE", path("acquisitions", id_of(acquisition)))

    def upload(
        self,
        acquisition: Acquisition | str,
        *,
        photos: Iterable[AnyPath] | AnyPath = (),
        cube: AnyPath | Sequence[AnyPath] | None = None,
        white: AnyPath | Sequence[AnyPath] | None = None,
        dark: AnyPath | Sequence[AnyPath] | None = None,
        progress: Listener | None = None,
        resume_file: AnyPath | None = None,
        patience_s: float = 600.0,
    ) -> builtins.list[File]:
        """Send files one after the other, and what the service says of each: ``refused``, ``reason``, ``advice``.

        A broken connection is taken up again where it broke; 8 MiB are held in memory. An ENVI header brings the
        data file beside it; where several lie there, name both as ``(header, data)``. With ``resume_file``, a small
        JSON file, another process goes on where this one stopped; it is removed when all has arrived. The service
        judges a file within ``patience_s``.

        Raises:
            UploadFailed: a file did not arrive; ``files`` are those that did.
        """
        return upload(self._session, id_of(acquisition), photos, cube, white, dark, progress, resume_file, patience_s)

    def files(self, acquisition: Acquisition | str) -> builtins.list[File]:
        """All files, refused ones too."""
        found = self._session.json("GET", path("acquisitions", id_of(acquisition), "files"))
        if not isinstance(found, builtins.list):
            raise UnexpectedAnswer("The answer is no list of files.")
        return [File.of(item) for item in found]

    def delete_file(self, acquisition: Acquisition | str, file: File | str) -> None:
        """Delete one file, so that it can be retaken."""
        self._session.request("DELETE", path("acquisitions", id_of(acquisition), "files", id_of(file)))

"""Photos, cube and references of one acquisition, sent one after the other, resumable across processes."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from specimap_client._errors import SpecimapClientError, UploadFailed
from specimap_client._http import Session
from specimap_client._models import File, Progress
from specimap_client._tus import GoneError, Tus

AnyPath = str | os.PathLike[str]
Listener = Callable[[Progress], None]
_DATA_SUFFIXES = ("", ".raw", ".img", ".dat", ".bil", ".bip", ".bsq", ".bin", ".hyspex", ".cube", ".hsi", ".envi")


@dataclass(frozen=True)
class _Item:
    role: str
    path: Path
    size: int
    stamp: str
    """Tells this content of the file from an earlier one."""


def upload(
    session: Session,
    acquisition: str,
    photos: Iterable[AnyPath] | AnyPath,
    cube: AnyPath | Sequence[AnyPath] | None,
    white: AnyPath | Sequence[AnyPath] | None,
    dark: AnyPath | Sequence[AnyPath] | None,
    progress: Listener | None,
    resume_file: AnyPath | None,
    patience_s: float,
) -> list[File]:
    """See :meth:`Acquisitions.upload`."""
    if isinstance(photos, str | os.PathLike):  # its letters would be taken for photos
        photos = [photos]
    items = [_item("photo", Path(photo)) for photo in photos]
    for role, given in (("cube", cube), ("white", white), ("dark", dark)):
        items += [_item(role, part) for part in _with_data(given)]
    notes = _Notes(Path(resume_file) if resume_file is not None else None, session.url, acquisition)
    tus = Tus(session, acquisition)
    arrived: list[File] = []
    total, before = sum(item.size for item in items), 0
    for item in items:

        def tell(sent: int, item: _Item = item, before: int = before) -> None:
            if progress is not None:
                progress(Progress(item.path.name, sent, item.size, before + sent, total))

        try:
            arrived.append(_send(tus, item, notes, tell, patience_s))
        except UploadFailed as error:
            error.files = tuple(arrived)
            raise
        except (SpecimapClientError, OSError) as error:
            code = getattr(error, "code", "upload_failed")
            failed = UploadFailed(f"{item.path.name} did not arrive. {error}", path=str(item.path), code=code)
            failed.files = tuple(arrived)
            raise failed from error
        before += item.size
    notes.forget_all()
    return arrived


def _send(tus: Tus, item: _Item, notes: _Notes, tell: Callable[[int], None], patience_s: float) -> File:
    """One file, judged."""
    known = notes.upload_of(item)
    for upload in (known, None):
        if upload is None:
            upload = tus.create(item.path, item.role, item.size)
            notes.keep(item, upload)
            known = None
        digest = None
        with suppress(GoneError):  # finished, with the answer lost; or expired
            digest = tus.send(upload, item.path, item.size, tell)
        try:
            file = tus.result(upload, patience_s, item.path)
        except UploadFailed:
            if known is None:
                raise
            continue  # what an earlier process began is of no use any more
        if file is None:
            raise UploadFailed(f"{item.path.name}: the service lost bytes.", path=str(item.path), upload_id=upload)
        if digest is not None and digest != file.sha256:
            raise UploadFailed(
                f"{item.path.name} arrived with another content than it has here.",
                path=str(item.path),
                code="checksum_wrong",
                advice="Delete the file there and upload it again.",
            )
        tell(item.size)
        return replace(file, path=item.path)
    raise AssertionError("the second upload is a new one")


def _item(role: str, path: Path) -> _Item:
    try:
        status = path.stat()
    except OSError as error:
        raise UploadFailed(f"{path.name} cannot be read. {error.strerror}.", path=str(path)) from error
    if not path.is_file() or status.st_size == 0:
        what = "is empty" if path.is_file() else "is no file"
        raise UploadFailed(f"{path.name} {what}.", path=str(path), code="file_empty")
    return _Item(role, path, status.st_size, f"{status.st_size}:{status.st_mtime_ns}")


def _with_data(given: AnyPath | Sequence[AnyPath] | None) -> list[Path]:
    """The files of a cube: an ENVI header brings the data file that lies beside it."""
    if given is None:
        return []
    if not isinstance(given, str | os.PathLike):
        return [Path(part) for part in given]
    header = Path(given)
    if header.suffix.lower() != ".hdr":
        return [header]
    stem = header.name[:-4].lower()
    wanted = {stem + suffix for suffix in _DATA_SUFFIXES}
    try:
        found = sorted(p for p in header.parent.iterdir() if p.name.lower() in wanted and p.is_file())
    except OSError as error:
        raise UploadFailed(f"{header.name} cannot be read. {error.strerror}.", path=str(header)) from error
    if len(found) != 1:
        what = "No data file lies" if not found else "Several data files lie"
        raise UploadFailed(
            f"{what} beside {header.name}.",
            path=str(header),
            code="cube_not_found",
            advice="Name both: (header, data).",
        )
    return [header, found[0]]


class _Notes:
    """Upload ids kept in a small file, so that another process goes on where this one stopped."""

    def __init__(self, path: Path | None, url: str, acquisition: str) -> None:
        self._path = path
        self._place = f"{url} {acquisition}"
        self._all: dict[str, dict[str, Any]] = {}
        if path is not None and path.exists():
            try:
                read = json.loads(path.read_text("utf-8"))
            except ValueError:
                read = None  # it only saves time; without it everything is sent
            if isinstance(read, dict):
                self._all = {k: v for k, v in read.items() if isinstance(v, dict)}
        self._own = self._all.setdefault(self._place, {})

    def upload_of(self, item: _Item) -> str | None:
        """The upload that was begun with this content of the file."""
        note = self._own.get(self._name(item))
        return str(note["upload"]) if isinstance(note, dict) and note.get("stamp") == item.stamp else None

    def keep(self, item: _Item, upload: str) -> None:
        """Note the upload."""
        self._own[self._name(item)] = {"upload": upload, "stamp": item.stamp}
        self._write()

    def forget_all(self) -> None:
        """All files have arrived."""
        del self._all[self._place]
        self._write()

    def _name(self, item: _Item) -> str:
        return f"{item.role} {item.path.resolve()}"

    def _write(self) -> None:
        if self._path is None:
            return
        if not self._all:
            self._path.unlink(missing_ok=True)
            return
        part = self._path.with_name(self._path.name + ".part")
        part.write_text(json.dumps(self._all, indent=1, allow_nan=False), "utf-8")
        os.replace(part, self._path)

"""Files from the service, resumed by range where the connection broke, in this process or an earlier one."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from specimap_client import _retries
from specimap_client._errors import (
    ConnectionFailed,
    NotFound,
    RateLimited,
    ServerError,
    Timeout,
    UnexpectedAnswer,
)
from specimap_client._http import Session, path

_DOCUMENT = "zarr.json"
_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")
Heard = Callable[[int, int], None]


def fetch(session: Session, address: str, target: Path, heard: Heard | None = None) -> Path:
    """Write what lies at the address to ``target``, whole or not at all; ``heard`` is told bytes there and of all.

    What has come is kept beside it as ``.part`` until all is there; it is gone on with if the service's file is
    still the same one.

    Raises:
        ApiError, ConnectionFailed, Timeout: nothing more came in as many attempts as ``Retries`` says.
    """
    part, note = target.with_name(target.name + ".part"), target.with_name(target.name + ".part.etag")
    failures, furthest = 0, -1
    while True:
        have = part.stat().st_size if part.exists() and note.exists() else 0
        if have > furthest:
            furthest, failures = have, 0
        try:
            if _more(session, address, part, note, have, heard):
                break
        except (ConnectionFailed, Timeout, ServerError, RateLimited) as error:
            failures += 1
            if failures >= session.retries.attempts:
                raise
            wait = error.retry_after if isinstance(error, RateLimited) else None
            _retries.sleep(session.retries.delay(failures - 1, wait))
    os.replace(part, target)
    note.unlink(missing_ok=True)
    return target


def _more(session: Session, address: str, part: Path, note: Path, have: int, heard: Heard | None) -> bool:
    """One request for what is missing; whether that was all."""
    # Without identity a proxy may compress, and offsets would count other bytes.
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers |= {"Range": f"bytes={have}-", "If-Range": note.read_text("utf-8")}
    with session.stream(address, headers=headers) as answer:
        found = _CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
        if answer.status_code == 416 or (answer.status_code == 206 and (not found or int(found[1]) != have)):
            note.unlink()  # it has another size now: from the start
            return False
        if answer.status_code == 206 and found:
            total = int(found[3])
        else:
            have, length = 0, answer.headers.get("Content-Length")
            if length is None:
                raise UnexpectedAnswer(f"{answer.request.url.path} does not tell its size.")
            total = int(length)
            note.unlink(missing_ok=True)
        with part.open("r+b" if have else "wb") as file:
            file.seek(have)
            # Only a strong tag says that the bytes are the same.
            tag = answer.headers.get("ETag", "")
            if tag.startswith('"'):
                note.write_text(tag, "utf-8")
            # As they come: gathered into larger pieces, the last ones would be lost with the connection.
            for piece in answer.iter_raw():
                file.write(piece)
                have += len(piece)
                if heard is not None:
                    heard(have, total)
            file.truncate(have)
            file.flush()
            os.fsync(file.fileno())
    if have != total:
        raise ConnectionFailed(f"{have} of {total} bytes came.")
    return True


def fetch_zarr(session: Session, cloud: str, target: Path, heard: Heard | None = None) -> Path:
    """Write a cloud's group, labels too, to the folder ``target``, whole or not at all.

    ``heard`` is told the files there and of all. What has come is kept in a folder beside it meanwhile.

    Raises:
        FileExistsError: there is something at ``target``.
    """
    if target.exists():
        raise FileExistsError(f"{target} exists.")
    part = target.with_name(f"{target.name}.{cloud}.part")
    # Another version of a label has the same keys; the rest of a cloud never changes.
    shutil.rmtree(part / "labels", ignore_errors=True)
    documents = _documents(session.json("GET", _address(cloud, _DOCUMENT)))
    keys: list[str] = []
    for name, document in documents.items():
        folder = part / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _DOCUMENT).write_text(json.dumps(document, indent=1, allow_nan=False), "utf-8")
        keys += [f"{name}/{chunk}" for chunk in chunk_keys(document)]
    for done, key in enumerate(keys):
        file = part / key
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with suppress(NotFound):  # a chunk of nothing but the fill value is not stored
                fetch(session, _address(cloud, key), file)
        if heard is not None:
            heard(done + 1, len(keys))
    os.rename(part, target)
    return target


def _documents(root: Any) -> dict[str, dict[str, Any]]:
    """Metadata of the group, under the name "", and of all below it; as stored, which is not consolidated."""
    try:
        members = root.pop("consolidated_metadata")["metadata"]
        if any(not re.fullmatch(r"[\w.-]+(/[\w.-]+)*", name) or ".." in name for name in members):
            raise ValueError("a name that leaves the folder")
        return {"": root, **members}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UnexpectedAnswer("The group does not tell what it holds.") from error


def chunk_keys(metadata: dict[str, Any]) -> Iterator[str]:
    """Keys of an array's chunks below it; none for a group.

    Raises:
        UnexpectedAnswer: the metadata are not of Zarr v3 with a regular grid.
    """
    if metadata.get("node_type") == "group":
        return
    try:
        shape, chunk = metadata["shape"], metadata["chunk_grid"]["configuration"]["chunk_shape"]
        encoding = metadata["chunk_key_encoding"]
        separator = encoding.get("configuration", {}).get("separator", "/")
        counts = [-(-size // step) for size, step in zip(shape, chunk, strict=True)]
        known = encoding["name"] == "default"
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise UnexpectedAnswer("The metadata of an array are not of Zarr v3.") from error
    if not known:
        raise UnexpectedAnswer("The keys of an array's chunks are of a kind that is not known.")
    for place in itertools.product(*map(range, counts)):
        yield separator.join(["c", *map(str, place)])


def _address(cloud: str, key: str) -> str:
    return path("clouds", cloud, "zarr", *key.split("/"))

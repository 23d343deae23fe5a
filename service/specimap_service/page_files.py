"""The web pages, served as they were built: the files that lie in their folder when the app is created, no others."""

from __future__ import annotations

import gzip
import hashlib
import os
import stat
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Match
from starlette.types import Receive, Scope, Send

from specimap_service.byte_ranges import known_to_client
from specimap_service.compression import takes_gzip
from specimap_service.security_headers import page_headers

FOLDER = Path(__file__).with_name("pages")
"""Where `make setup` builds the pages; they are in the wheel."""
START = "index.html"
ASSETS = "assets/"
"""Files there have a hash of their content in their names."""
NAME = "pages"
MEDIA_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".ico": "image/x-icon",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".map": "application/json",
    ".mjs": "text/javascript; charset=utf-8",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
    ".webmanifest": "application/manifest+json",
    ".webp": "image/webp",
    ".woff2": "font/woff2",
}
"""By suffix, since what a machine knows of suffixes differs; all others are bytes."""
COMPRESSED = (".css", ".html", ".ico", ".js", ".json", ".map", ".mjs", ".svg", ".txt", ".wasm", ".webmanifest")
NOT_BUILT = b"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Specimap</title>
<h1>Specimap</h1>
<p>The service runs, but its pages are not built: run <code>make setup</code>, then start it again.</p>
<p><a href="docs">The API</a> is there.</p>
</html>
"""


@dataclass(frozen=True)
class PageFile:
    """A file of the pages, in memory."""

    name: str
    """Its path within the folder, with slashes."""
    content: bytes

    @property
    def media_type(self) -> str:
        """Its media type, by its suffix."""
        return MEDIA_TYPES.get(PurePosixPath(self.name).suffix, "application/octet-stream")

    @property
    def cache(self) -> str:
        """How long browsers keep it."""
        return "public, max-age=31536000, immutable" if self.name.startswith(ASSETS) else "no-cache"

    @cached_property
    def digest(self) -> str:
        """A hash of the content."""
        return hashlib.sha256(self.content).hexdigest()[:32]

    @cached_property
    def gzipped(self) -> bytes | None:
        """The content compressed, once, at the first request; None where that gains nothing."""
        if PurePosixPath(self.name).suffix not in COMPRESSED:
            return None
        made = gzip.compress(self.content, compresslevel=9, mtime=0)
        return made if len(made) < len(self.content) else None


def read_pages(folder: Path) -> dict[str, PageFile]:
    """Read the files of a folder, by the paths at which they are served; none where there is no such folder.

    Links, hidden files and what is in hidden folders are left out.
    """
    found: dict[str, PageFile] = {}
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            path = Path(place, name)
            if not name.startswith(".") and stat.S_ISREG(path.lstat().st_mode):
                own = path.relative_to(folder).as_posix()
                found[f"/{own}"] = PageFile(own, path.read_bytes())
    found["/"] = found.get(f"/{START}") or PageFile(START, NOT_BUILT)
    return found


class Pages(BaseRoute):
    """The route of all pages: it knows its files by name, so that no other path leads anywhere."""

    path = path_format = name = NAME
    """Under which metrics and log count their requests."""

    def __init__(self, folder: Path) -> None:
        self._files = read_pages(folder)
        self._headers = page_headers()

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match a request for one of the files."""
        if scope["type"] != "http" or scope["path"] not in self._files or scope["method"] not in ("GET", "HEAD"):
            return Match.NONE, {}
        return Match.FULL, {"route": self}

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer with the file; a query counts for the page's own scripts alone."""
        # In a thread, since the first request for a file compresses it.
        answer = await run_in_threadpool(self._answer, Request(scope), self._files[scope["path"]])
        await answer(scope, receive, send)

    def _answer(self, request: Request, file: PageFile) -> Response:
        gzipped = file.gzipped if takes_gzip(request.headers) else None
        # A tag names bytes: compressed ones have another.
        etag = f'"{file.digest}{"" if gzipped is None else "-gzip"}"'
        headers = {**self._headers, "ETag": etag, "Cache-Control": file.cache, "Vary": "Accept-Encoding"}
        if known_to_client(request, etag):
            return Response(status_code=304, headers=headers)
        if gzipped is not None:
            headers["Content-Encoding"] = "gzip"
        return Response(file.content if gzipped is None else gzipped, headers=headers, media_type=file.media_type)

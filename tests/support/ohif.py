"""The OHIF viewer, as its makers build it, in front of an archive: static files and a small proxy on loopback."""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import os
import shutil
import subprocess
import tarfile
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.orthanc import RunningOrthanc
from tests.support.places import ROOT

PACKAGE = "@ohif/app@3.13.2"
INTEGRITY = "sha512-WZdxmpmG7rqFgW9ZJLcbgr3XCtLi1KDNPoMaeY5PPe6j4G4fjEjjkycZM6C6Zk2F87BKxFfpq+jd5xXZB9E8EA=="
FOLDER = ROOT / "out" / "ohif-3.13.2"
"""Git ignores it; fetched once for a checkout."""
_DICOMWEB = "/dicom-web"
_SECONDS = 600
_CONFIG = {
    "routerBasename": "/",
    "extensions": [],
    "modes": [],
    "showStudyList": True,
    "showWarningMessageForCrossOrigin": False,
    "showCPUFallbackMessage": False,
    "investigationalUseDialog": {"option": "never"},
    "defaultDataSourceName": "dicomweb",
    "dataSources": [
        {
            "namespace": "@ohif/extension-default.dataSourcesModule.dicomweb",
            "sourceName": "dicomweb",
            "configuration": {
                "friendlyName": "Orthanc",
                "name": "orthanc",
                "wadoUriRoot": _DICOMWEB,
                "qidoRoot": _DICOMWEB,
                "wadoRoot": _DICOMWEB,
                "qidoSupportsIncludeField": False,
                "imageRendering": "wadors",
                "thumbnailRendering": "wadors",
                "enableStudyLazyLoad": True,
                "supportsFuzzyMatching": False,
                "supportsWildcard": True,
                "bulkDataURI": {"enabled": True},
            },
        }
    ],
}


def ohif_folder() -> Path:
    """The built viewer; fetched by npm where it is not there yet, and checked against its known sum."""
    if not FOLDER.is_dir():
        npm = shutil.which("npm", path=f"{ROOT / '.venv' / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}")
        if npm is None:
            pytest.skip("there is no npm, which fetches the OHIF viewer: make setup")
        FOLDER.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".ohif-", dir=FOLDER.parent) as work:
            _fetch(npm, Path(work))
            try:
                (Path(work) / "package" / "dist").rename(FOLDER)
            except OSError:  # another process of the same run was faster
                assert FOLDER.is_dir()
    return FOLDER


def _fetch(npm: str, work: Path) -> None:
    environment = {**os.environ, "PATH": f"{Path(npm).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        [npm, "pack", PACKAGE, "--silent"], cwd=work, env=environment, capture_output=True, text=True, timeout=_SECONDS
    )
    assert done.returncode == 0, f"npm could not fetch {PACKAGE}: {done.stderr[-500:]}"
    (archive,) = work.glob("*.tgz")
    found = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    assert f"sha512-{found}" == INTEGRITY, f"{PACKAGE} is not what it was"
    with tarfile.open(archive) as members:
        wanted = [m for m in members if m.name.startswith("package/dist/") and not m.name.endswith(".map")]
        members.extractall(work, members=wanted, filter="data")


@contextmanager
def ohif(archive: RunningOrthanc) -> Iterator[str]:
    """The address of a viewer on what an archive holds, until the block ends."""
    folder, target = ohif_folder(), urlsplit(archive.url)
    token = base64.b64encode(":".join(archive.auth).encode()).decode()

    class Handler(SimpleHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments, directory=str(folder))  # type: ignore[arg-type]

        def log_message(self, format: str, *arguments: object) -> None:
            return

        def do_GET(self) -> None:
            if self.path.startswith(f"{_DICOMWEB}/"):
                self._pass_on()
            elif self.path.startswith("/app-config.js"):
                self._answer(f"window.config = {json.dumps(_CONFIG)};".encode(), "text/javascript")
            else:
                if not (folder / urlsplit(self.path).path.lstrip("/")).is_file():
                    self.path = "/index.html"  # the viewer's own routes
                super().do_GET()

        def end_headers(self) -> None:
            self.send_header("Cross-Origin-Opener-Policy", "same-origin")
            self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
            super().end_headers()

        def _pass_on(self) -> None:
            connection = http.client.HTTPConnection(target.hostname or "", target.port, timeout=60)
            headers = {"Authorization": f"Basic {token}", "Host": self.headers["Host"]}
            headers["Accept"] = self.headers.get("Accept", "*/*")
            try:
                connection.request("GET", self.path, headers=headers)
                answer = connection.getresponse()
                self._answer(answer.read(), answer.getheader("Content-Type", ""), answer.status)
            finally:
                connection.close()

        def _answer(self, body: bytes, kind: str, status: int = 200) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join(10)

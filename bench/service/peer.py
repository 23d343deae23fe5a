"""nginx on the same files: the bar for whoever sends bytes."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

START_SECONDS = 10
CONFIG = """\
daemon off;
worker_processes auto;
pid {work}/nginx.pid;
error_log {work}/error.log;
{user}
events {{ worker_connections 1024; }}
http {{
    access_log {work}/access.log;
    default_type application/octet-stream;
    sendfile on;
    tcp_nopush on;
    keepalive_requests 1000000000;
    client_max_body_size 0;
    client_body_temp_path {work}/body;
    proxy_temp_path {work}/proxy;
    fastcgi_temp_path {work}/fastcgi;
    uwsgi_temp_path {work}/uwsgi;
    scgi_temp_path {work}/scgi;
    server {{
        listen 127.0.0.1:{port};
        root {root};
        location /put/ {{ dav_methods PUT; create_full_put_path on; }}
    }}
}}
"""


@dataclass(frozen=True)
class Nginx:
    """An nginx that serves ``root`` and takes files by PUT below ``/put/``."""

    address: tuple[str, int]
    root: Path


def nginx_version() -> str | None:
    """``nginx/1.22.1``; None where none is in PATH."""
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        return None
    said = subprocess.run([program, "-v"], capture_output=True, text=True, check=False).stderr
    return said.rpartition(": ")[2].strip()


NO_NGINX = "nginx is not in PATH: its columns are empty (Debian, Ubuntu: apt install nginx-light)."


@contextmanager
def nginx(root: Path, work: Path) -> Iterator[Nginx | None]:
    """Serve the folder ``root`` until the block ends; all that nginx writes goes to the new folder ``work``.

    Gives None where there is no nginx. Raises RuntimeError where it does not start.
    """
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        yield None
        return
    work.mkdir(parents=True)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    # Started by root, its workers would become somebody who may not look into a temporary folder.
    user = f"user {pwd.getpwuid(os.geteuid()).pw_name};" if os.geteuid() == 0 else ""
    config = work / "nginx.conf"
    config.write_text(CONFIG.format(work=work, user=user, port=port, root=root), encoding="utf-8")
    process = subprocess.Popen(
        [program, "-p", str(work), "-e", str(work / "error.log"), "-c", str(config)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError as error:
                if process.poll() is not None or time.monotonic() > deadline:
                    said = (work / "error.log").read_text(encoding="utf-8")[-2000:]
                    raise RuntimeError(f"nginx does not start:\n{said}") from error
                time.sleep(0.02)
        yield Nginx(("127.0.0.1", port), root)
    finally:
        process.terminate()
        process.wait()

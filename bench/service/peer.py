"""Other servers on the same files: nginx, which only sends bytes; Tiled, which serves arrays over HTTP.

Both are found in PATH, are started on a free port with all they write in a folder of their own, and are left out where
they are missing.
"""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

START_SECONDS = 60
STOP_SECONDS = 10
NO_NGINX = "nginx is not in PATH: its columns are empty (Debian, Ubuntu: apt install nginx-light)."
NO_TILED = "tiled is not in PATH and left out (pip install 'tiled[server]', best in an environment of its own)."
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


Address = tuple[str, int]


@dataclass(frozen=True)
class Nginx:
    """An nginx that serves ``root`` and takes files by PUT below ``/put/``."""

    address: Address
    root: Path


def nginx_version() -> str | None:
    """``1.22.1``; None where none is in PATH."""
    program = _nginx()
    if program is None:
        return None
    output = subprocess.run([program, "-v"], capture_output=True, text=True, check=False).stderr
    return output.rpartition("/")[2].strip()


@contextmanager
def nginx(root: Path, work: Path) -> Iterator[Nginx | None]:
    """Serve the folder ``root`` until the block ends; all that nginx writes goes to the new folder ``work``.

    Gives None where there is no nginx. Raises RuntimeError where it does not start.
    """
    program = _nginx()
    if program is None:
        yield None
        return
    work.mkdir(parents=True)
    port = _free_port()
    # Started by root, its workers would become somebody who may not look into a temporary folder.
    user = f"user {pwd.getpwuid(os.geteuid()).pw_name};" if os.geteuid() == 0 else ""
    config = work / "nginx.conf"
    config.write_text(CONFIG.format(work=work, user=user, port=port, root=root), encoding="utf-8")
    command = [program, "-p", str(work), "-e", str(work / "error.log"), "-c", str(config)]
    with _running(command, port, work / "error.log"):
        yield Nginx(("127.0.0.1", port), root)


@contextmanager
def tiled(group: Path, work: Path) -> Iterator[Address | None]:
    """Serve a Zarr group as ``cloud`` until the block ends; None where there is no Tiled. As :func:`nginx`."""
    program = shutil.which("tiled")
    if program is None:
        yield None
        return
    shutil.copytree(group, work / "root" / "cloud.zarr", copy_function=os.link)
    port = _free_port()
    command = [program, "serve", "directory", "--public", "--port", str(port), str(work / "root")]
    with _running(command, port, work / "tiled.log"):
        deadline = time.monotonic() + START_SECONDS
        # It listens before it has walked the folder.
        while "Indexing complete" not in (work / "tiled.log").read_text(encoding="utf-8"):
            if time.monotonic() > deadline:
                raise RuntimeError(f"tiled does not start:\n{_end_of(work / 'tiled.log')}")
            time.sleep(0.1)
        yield "127.0.0.1", port


def tiled_version() -> str | None:
    """``0.2.20``; None where none is in PATH."""
    program = shutil.which("tiled")
    if program is None:
        return None
    output = subprocess.run([program, "--version"], capture_output=True, text=True, check=False).stdout
    return output.strip().rpartition(" ")[2]


@contextmanager
def _running(command: Sequence[str], port: int, log: Path) -> Iterator[None]:
    """A server until the block ends, once its port answers. Raises RuntimeError where it does not."""
    with open(log, "ab") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env={**os.environ, "HOME": str(log.parent)})
    try:
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError as error:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"{command[0]} does not start:\n{_end_of(log)}") from error
                time.sleep(0.02)
        yield
    finally:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _nginx() -> str | None:
    # Debian keeps it where only root looks.
    return shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin:/usr/local/sbin")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _end_of(log: Path) -> str:
    return log.read_text(encoding="utf-8", errors="replace")[-2000:]

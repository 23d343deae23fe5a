"""``specimap demo``: the sample through a service of its own: upload, job, progress, report, a link to the viewer."""

from __future__ import annotations

import datetime
import os
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from specimap_cli.invocation import program
from specimap_cli.progress import Listener, UploadBar
from specimap_core.atomic import atomic_path, remove
from specimap_core.errors import BackendUnavailableError, NotFoundError, SpecimapError
from specimap_core.report.model import Report

if TYPE_CHECKING:
    from specimap_client import Client, Cloud

START_SECONDS = 60.0
LISTENS = "Specimap listens on "
KEY = "spk_"
LINK_DAYS = 7


def demo(
    samples: Path, out: Path, listener: Listener, *, stay: bool, show: bool = False, say: Callable[[str], None]
) -> None:
    """Start a service on ``out / "service"``, run the sample through it, leave the results in ``out``.

    ``stay``: let the service go on until Ctrl-C, with a link that opens the result in a browser; ``show`` opens it.

    Raises:
        NotFoundError: there is no sample.
        BackendUnavailableError: the client is not installed, or the service does not start.
        SpecimapError: with the code of an error of the service.
    """
    try:
        from specimap_client import ApiError, Client, JobFailed
    except ImportError as error:
        raise BackendUnavailableError(
            "The demo needs the package specimap-client.", advice="Install it: pip install ./client"
        ) from error
    photos, cube = sorted((samples / "rgb").glob("*.jpg")), samples / "hsi" / "hsi.hdr"
    if not photos or not cube.is_file():
        raise NotFoundError(f"{samples} holds no sample.", advice="Name the folder samples/ of the source.")
    with _service(out / "service") as (url, key):
        say(f"The demo's service listens on {url}")
        try:
            with Client(url, key) as client:
                cloud = _run(client, photos, cube, out, listener, say)
                if stay:
                    until = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=LINK_DAYS)
                    link = cloud.share("demo", until).link
        except JobFailed as failed:
            why = failed.job.error
            raise _error_of_service(
                failed.code, why.message if why else str(failed), why.advice if why else ""
            ) from failed
        except ApiError as refused:
            raise _error_of_service(refused.code, refused.message, refused.advice) from refused
        if stay:
            say(f"The result in 3D: {link}")
            say(f"The service goes on at {url}, the API is described at {url}/docs. The demo's key is {key}")
            say("Ctrl-C ends it.")
            if show and not webbrowser.open(link):
                say("No browser could be opened: open the link yourself.")
            threading.Event().wait()
    say(f"To see the result in 3D: {program()} demo --open")
    say(f"To serve these results again: export SPECIMAP_DATA_DIR={out / 'service'}; {program()} serve")
    say(f"A key for it: {program()} keys create --name me --scope admin")


def _run(
    client: Client, photos: list[Path], cube: Path, out: Path, listener: Listener, say: Callable[[str], None]
) -> Cloud:
    acquisition = client.acquisitions.create("SAMPLE-A", notes="The sample that comes with Specimap.")
    with UploadBar() as bar:
        files = client.acquisitions.upload(
            acquisition, photos=photos, cube=cube, progress=lambda p: bar.update(p.total_sent, p.total_size)
        )
    accepted = sum(f.state == "accepted" for f in files)
    say(f"{accepted} of {len(files)} files accepted; each was judged as it arrived.")
    with listener:
        job = client.jobs.wait(
            client.jobs.submit(acquisition, priority="intraoperative"),
            progress=lambda job: listener.progress(job.stage, job.progress) if job.stage else None,
        )
    assert job.cloud_id is not None
    cloud = client.clouds.get(job.cloud_id)
    report = Report.model_validate(client.jobs.report(job).raw)
    listener.report(report)
    out.mkdir(parents=True, exist_ok=True)
    text = report.model_dump_json(indent=1).encode()
    documents = {
        "report.json": text,
        "preview.png": cloud.preview("pca"),
        "corners.json": cloud.corners(),
        "cameras.json": cloud.cameras(),
    }
    for name, data in documents.items():
        with atomic_path(out / name) as aside:
            aside.write_bytes(data)
    cloud.export("mesh-ply", out / "mesh.ply")
    remove(out / "cloud.zarr")
    cloud.download(out / "cloud.zarr")
    for name in ("cloud.zarr", "mesh.ply", *sorted(documents)):
        say(f"{name:<12} {out / name}")
    return cloud


def _error_of_service(code: str, message: str, advice: str) -> SpecimapError:
    """Make one of our errors from the service's, with its code."""
    leaf = type("ServiceError", (SpecimapError,), {"code": code})
    error = leaf(message, advice=advice)
    assert isinstance(error, SpecimapError)
    return error


@contextmanager
def _service(folder: Path) -> Iterator[tuple[str, str]]:
    """Start a service on a folder and a free port; yield its address and a new administrator's key."""
    remove(folder)
    folder.mkdir(parents=True, mode=0o700)
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")},
        "SPECIMAP_DATA_DIR": str(folder.absolute()),
        "SPECIMAP_PORT": "0",
        "SPECIMAP_MIN_FREE_BYTES": "0",
        "PYTHONUNBUFFERED": "1",
    }
    log = open(folder / "service.log", "wb")  # noqa: SIM115 - outlives this block's first lines
    process = subprocess.Popen(
        [sys.executable, "-c", "from specimap_cli import main; main()", "serve"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
    )
    try:
        yield _read_address_and_key(process, folder / "service.log")
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        log.close()


def _read_address_and_key(process: subprocess.Popen[str], log: Path) -> tuple[str, str]:
    """Wait for the address and the key that the service prints."""
    found: dict[str, str] = {}
    complete = threading.Event()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith(LISTENS):
                found["url"] = line.removeprefix(LISTENS).strip()
            if line.startswith(KEY):
                found["key"] = line.strip()
                complete.set()

    threading.Thread(target=read, daemon=True).start()
    deadline = time.monotonic() + START_SECONDS
    while not complete.wait(0.1):
        if process.poll() is not None or time.monotonic() > deadline:
            raise BackendUnavailableError("The service did not start.", advice=f"{log} says why.", log=str(log))
    return found["url"], found["key"]

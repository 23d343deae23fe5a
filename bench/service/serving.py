"""A real service: ``specimap serve`` as a process of its own, and what that process takes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from specimap_client import Client
from specimap_infra.settings import ServiceSettings, load_settings

START_SECONDS = 60
NO_SETTINGS: Mapping[str, str] = MappingProxyType({})
TICKS = os.sysconf("SC_CLK_TCK")
COMMAND = (sys.executable, "-c", "from specimap_cli import main; main()", "serve")


@dataclass(frozen=True)
class Served:
    """A service that answers at ``url``, and its administrator's key; ``pid`` is the API's process."""

    url: str
    key: str
    pid: int
    folder: Path
    given: dict[str, str] = field(default_factory=dict)
    """Settings besides those of everybody."""

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        host, _, port = self.url.removeprefix("http://").rpartition(":")
        return host, int(port)

    @property
    def bearer(self) -> str:
        """Value of the header Authorization."""
        return f"Bearer {self.key}"

    @property
    def settings(self) -> ServiceSettings:
        """Of the same database and storage."""
        return load_settings(data_dir=self.folder, **self.given)

    def client(self) -> Client:
        """A client with that key."""
        return Client(self.url, self.key)

    def cpu_seconds(self) -> float:
        """Processor time of the API's process so far, all threads."""
        fields = Path(f"/proc/{self.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def memory_mb(self) -> float:
        """Resident memory of the API's process."""
        return self._status("VmRSS")

    def peak_mb(self) -> float:
        """The most that was resident since :meth:`forget_peak`, as the kernel counted it."""
        return self._status("VmHWM")

    def forget_peak(self) -> None:
        """Count the peak from now on."""
        Path(f"/proc/{self.pid}/clear_refs").write_text("5", encoding="ascii")

    def _status(self, name: str) -> float:
        lines = Path(f"/proc/{self.pid}/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) / 1024


@contextmanager
def serving(folder: Path, *, worker: bool = False, given: Mapping[str, str] = NO_SETTINGS) -> Iterator[Served]:
    """Serve from a new folder until the block ends, with the settings that a person gets who sets none, but for the
    rate limit, which a benchmark would meet, and those ``given``. The log goes to ``service.log`` in the folder.

    Raises:
        RuntimeError: it does not start; with the end of its log.
    """
    folder.mkdir(parents=True)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")}
    environment |= {"SPECIMAP_DATA_DIR": str(folder), "SPECIMAP_PORT": "0", "SPECIMAP_RATE_PER_MINUTE": str(10**9)}
    environment |= {f"SPECIMAP_{name.upper()}": value for name, value in given.items()}
    log = folder / "service.log"
    with open(log, "wb") as errors:
        process = subprocess.Popen(
            [*COMMAND, "--worker" if worker else "--no-worker"],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env={**environment, "PYTHONUNBUFFERED": "1"},
        )
    # The start fails by the end of its output; a start that hangs is ended, which ends its output.
    hung = threading.Timer(START_SECONDS, process.kill)
    hung.start()
    try:
        printed, output = "", process.stdout
        assert output is not None
        for line in output:
            printed += line
            if re.search(r"^spk_\S+$", printed, re.MULTILINE):
                break
        hung.cancel()
        url, key = re.search(r"listens on (http://\S+)", printed), re.search(r"^spk_\S+$", printed, re.MULTILINE)
        if url is None or key is None:
            process.wait()
            raise RuntimeError(f"specimap serve does not start:\n{printed}{log.read_text(encoding='utf-8')[-2000:]}")
        yield Served(url[1], key[0], process.pid, folder, dict(given))
    finally:
        hung.cancel()
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()

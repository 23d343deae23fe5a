"""Worklists of real servers: entries as ``dump2dcm`` makes them, served by Orthanc or by dcmtk's ``wlmscpfs``."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ENTRY = """\
(0008,0005) CS [ISO_IR 192]
(0008,0050) SH [{accession}]
(0008,0090) PN [Strange^Stephen]
(0010,0010) PN [{name}]
(0010,0020) LO [{patient}]
(0010,0030) DA [19510203]
(0010,0040) CS [F]
(0020,000d) UI [{study}]
(0032,1060) LO [Excision, left side]
(0040,1001) SH [RP-1]
(0040,0100) SQ
(fffe,e000) na
(0008,0060) CS [XC]
(0040,0001) AE [{station}]
(0040,0002) DA [20261122]
(0040,0003) TM [093000]
(0040,0006) PN [Doe^John]
(0040,0007) LO [Macroscopy]
(0040,0009) SH [SPS-1]
(0040,0010) SH [{station}]
(0040,0500) SQ
(fffe,e000) na
(0040,0512) LO [CONT-{accession}]
(0040,0513) SQ
(fffe,e000) na
(0040,0031) UT [LAB]
(fffe,e00d) na
(fffe,e0dd) na
(0040,0560) SQ
(fffe,e000) na
(0040,0551) LO [SPEC-{accession}]
(0040,0554) UI [2.25.4711]
(0040,0600) LO [Skin, left side]
(fffe,e00d) na
(fffe,e0dd) na
(fffe,e00d) na
(fffe,e0dd) na
(fffe,e00d) na
(fffe,e0dd) na
"""


def write_entry(
    folder: Path, accession: str, *, patient: str = "P-1", name: str = "Doe^Jané", station: str = "SPECIMAP"
) -> None:
    """Write a worklist file."""
    program = shutil.which("dump2dcm")
    if program is None:
        pytest.skip("there is no dump2dcm: apt-get install dcmtk")
    folder.mkdir(parents=True, exist_ok=True)
    study = f"2.25.{abs(hash(accession))}"
    text = ENTRY.format(accession=accession, patient=patient, name=name, station=station, study=study)
    source = folder / f"{accession}.dump"
    source.write_text(text, "utf-8")
    subprocess.run([program, "-g", str(source), str(folder / f"{accession}.wl")], check=True, timeout=30)
    source.unlink()


@contextmanager
def wlmscpfs(folder: Path, title: str = "WORKLIST") -> Iterator[int]:
    """Serve the entries in ``folder / title`` with dcmtk's own server. Its port."""
    program = shutil.which("wlmscpfs")
    if program is None:
        pytest.skip("there is no wlmscpfs: apt-get install dcmtk")
    (folder / title).mkdir(parents=True, exist_ok=True)
    (folder / title / "lockfile").touch()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    process = subprocess.Popen([program, "-csk", "-dfp", str(folder), str(port)])
    try:
        end = time.monotonic() + 20
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except OSError:
                assert time.monotonic() < end, "wlmscpfs did not start"
                time.sleep(0.1)
        yield port
    finally:
        process.kill()
        process.wait(10)

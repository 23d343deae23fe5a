"""Uploaded files that lead elsewhere, sent with a key for uploads alone: nothing but the file itself is read."""

from __future__ import annotations

import io
import json
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import httpx
import numpy as np
import pytest
import tifffile

from specimap_core.sandbox import protection
from specimap_service.acquisitions.judge import Judge
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition, photos, send, sent

SHAPE = (6, 5, 4)
CUBE = np.random.default_rng(0).integers(1, 4000, SHAPE).astype(np.uint16)
SECRET_NM = [412.25, 433.5, 871.125, 998.75]
"""What the secret file holds, as a reader of wavelengths would understand it."""
SECRET = np.array(SECRET_NM, "<f8").tobytes()

# Readers without a guard of their own, as a library is before anybody thinks of it.
NAIVE = """
import glob, json, sys
from pathlib import Path
import h5py, numpy as np, tifffile
from specimap_core.screening import process as child
from specimap_core.screening.verdict import Verdict

def whole(task):
    return Verdict(facts={"part": "whole", "suffix": ".tif" if open(task["path"], "rb").read(2) == b"II" else ".h5"})

def naive(task):
    if task["path"].endswith(".tif"):
        values = tifffile.imread(task["path"]).astype(float).ravel()[:4]
    else:
        with h5py.File(task["path"]) as file:
            values = file["wavelength"][()].astype(float)
    return Verdict(facts={"wavelength_nm": [float(values.min()), float(values.max())]})

child.TASKS["part"], child.TASKS["cube"] = whole, naive
child.main()
"""


def external(place: str, folder: Path) -> bytes:
    with h5py.File(folder / "a.h5", "w") as f:
        f["cube"] = CUBE
        f.create_dataset("wavelength", (4,), "<f8", external=[(place, 0, len(SECRET))])
        f["wavelength"].attrs["units"] = "nm"
    return (folder / "a.h5").read_bytes()


def linked(place: str, folder: Path) -> bytes:
    with h5py.File(folder / "b.h5", "w") as f:
        f["cube"] = CUBE
        f["wavelength"] = h5py.ExternalLink(place, "/secret")
    return (folder / "b.h5").read_bytes()


def virtual(place: str, folder: Path) -> bytes:
    layout = h5py.VirtualLayout((4,), "<f8")
    layout[:] = h5py.VirtualSource(place, "/secret", (4,), "<f8")
    with h5py.File(folder / "c.h5", "w") as f:
        f["cube"] = CUBE
        f.create_virtual_dataset("wavelength", layout)
    return (folder / "c.h5").read_bytes()


def ome(place: str, folder: Path) -> bytes:
    """An OME-TIFF of one page whose description says that the pixels are another file's."""
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="double" SizeX="4" SizeY="1" SizeC="1" '
        'SizeZ="1" SizeT="2"><Channel ID="Channel:0" SamplesPerPixel="1"/>'
        f'<TiffData IFD="0" FirstT="0" PlaneCount="1"><UUID FileName="{place}">urn:uuid:0</UUID></TiffData>'
        '<TiffData IFD="0" FirstT="1" PlaneCount="1"><UUID FileName="own.tif">urn:uuid:1</UUID></TiffData>'
        "</Pixels></Image></OME>"
    )
    tifffile.imwrite(folder / "own.ome.tif", np.zeros((1, 4)), description=text, metadata=None)
    return (folder / "own.ome.tif").read_bytes()


HOSTILE: dict[str, Callable[[str, Path], bytes]] = {
    "external": external,
    "linked": linked,
    "virtual": virtual,
    "ome": ome,
}


def secrets_in(folder: Path) -> dict[str, Path]:
    """The same secret as plain bytes, in an HDF5 file and in a TIFF, for its owner's eyes alone."""
    folder.mkdir()
    places = {"external": folder / "secret", "linked": folder / "secret.h5", "ome": folder / "secret.tif"}
    places["external"].write_bytes(SECRET)
    with h5py.File(places["linked"], "w") as f:
        f["secret"] = np.array(SECRET_NM)
    tifffile.imwrite(places["ome"], np.array(SECRET_NM)[None])
    for place in places.values():
        place.chmod(0o600)
    return {**places, "virtual": places["linked"]}


def uploaded(service: Running, data: bytes, name: str) -> dict[str, Any]:
    client = service.client(("upload", "read"))
    return sent(client, new_acquisition(client), "cube", name, data)


def shows_secret(file: dict[str, Any]) -> bool:
    text = json.dumps(file)
    return any(f"{value:g}" in text for value in SECRET_NM)


@dataclass(frozen=True)
class Beside:
    """A service in a folder, and next to it the secrets by the kind of file that leads to them."""

    folder: Path
    service: Running
    secrets: dict[str, Path]


@contextmanager
def beside_secrets(folder: Path, sandbox: str) -> Iterator[Beside]:
    with serving(folder / "service", own_judge=True, sandbox=sandbox) as service:
        yield Beside(folder, service, secrets_in(folder / "elsewhere"))


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    """Files are judged as usual."""
    with beside_secrets(tmp_path_factory.mktemp("usual"), "best-effort") as made:
        yield made


@pytest.fixture(scope="module", params=["require", "off"])
def naive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    """Files are judged by readers without a guard, confined or not."""
    with beside_secrets(tmp_path_factory.mktemp("naive"), request.param) as made:
        judge: Judge = made.service.app.state.judge
        judge._command = (sys.executable, "-c", NAIVE, *judge._command[3:])
        yield made


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_file_that_leads_elsewhere_tells_nothing(kind: str, relative: bool, usual: Beside, tmp_path: Path) -> None:
    secret = usual.secrets[kind]
    # A judged file lies four folders below that of the service and the secrets.
    place = f"../../../../elsewhere/{secret.name}" if relative else str(secret)
    data = HOSTILE[kind](place, tmp_path)
    assert not shows_secret(uploaded(usual.service, data, "x.tif" if kind == "ome" else "x.h5"))


@pytest.mark.slow
@pytest.mark.skipif(not protection().whole, reason="this kernel does not confine")
@pytest.mark.parametrize("kind", HOSTILE)
def test_confinement_holds_alone_where_a_reader_would_follow(kind: str, naive: Beside, tmp_path: Path) -> None:
    sandbox = naive.service.settings.sandbox
    data = HOSTILE[kind](str(naive.secrets[kind]), tmp_path)
    file = uploaded(naive.service, data, "x.tif" if kind == "ome" else "x.h5")
    # Without it the reader follows, which shows that the file is what it should be.
    assert shows_secret(file) == (sandbox == "off" and (kind != "ome" or _follows(data, tmp_path)))
    if sandbox == "require" and kind in ("external", "linked"):  # of the others a library makes up values
        assert (file["state"], file["judgement"]["code"]) == ("refused", "judging_crashed")


def _follows(data: bytes, folder: Path) -> bool:
    """Whether this release of tifffile follows names that lead out of the file's folder."""
    (folder / "follow.ome.tif").write_bytes(data)
    return bool(np.isin(SECRET_NM, tifffile.imread(folder / "follow.ome.tif")).all())


def npz(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def test_other_formats_that_name_paths_write_and_tell_nothing(usual: Beside) -> None:
    secret = usual.secrets["external"]
    value = io.BytesIO()
    np.save(value, CUBE)
    link = zipfile.ZipInfo("cube.npy")
    link.external_attr = 0o120777 << 16
    pickled = io.BytesIO()
    np.save(pickled, np.array([Opener(str(usual.folder / "made"))], object), allow_pickle=True)
    header = (
        f"ENVI\nsamples = 5\nlines = 6\nbands = 4\ndata type = 12\ninterleave = bsq\nbyte order = 0\n"
        f"header offset = 0\ndata file = {secret}\nwavelength = {{{secret}}}\n"
    )
    files = {
        "slip.npz": npz({"../../../../made.npy": value.getvalue()}),
        "absolute.npz": npz({f"{usual.folder}/made": b"x"}),
        "pickle.npy": pickled.getvalue(),
        "named.hdr": header.encode(),
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr(link, str(secret))
    files["link.npz"] = out.getvalue()
    for name, data in files.items():
        file = uploaded(usual.service, data, name)
        assert not shows_secret(file), name
        assert SECRET.hex() not in json.dumps(file)
    assert not list(usual.folder.glob("made*"))


class Opener:
    """Unpickled, it makes a file."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str, str]]:
        return open, (self._path, "w")


def test_photos_that_are_not_what_they_seem_tell_nothing(usual: Beside, tmp_path: Path) -> None:
    secret = usual.secrets["external"]
    beyond = struct.pack("<2sHIHHHII", b"II", 42, 8, 1, 273, 4, 1, 2**31) + bytes(4)
    files = {
        "offset.tif": beyond,
        "own.ome.tif": ome(str(secret), tmp_path),
        "a.svg": f'<svg><image href="file://{secret}"/></svg>'.encode(),
        "a.eps": f"%!PS-Adobe-3.0 EPSF-3.0\n({secret}) (r) file\n".encode(),
        "a.fpx": bytes.fromhex("d0cf11e0a1b11ae1") * 100,
    }
    client = usual.service.client(("upload", "read"))
    acquisition = new_acquisition(client)
    for name, data in files.items():
        assert not shows_secret(sent(client, acquisition, "photo", name, data)), name
    assert sent(client, acquisition, "photo", "good.jpg", photos()[0].read_bytes())["state"] == "accepted"


@pytest.mark.slow
def test_a_key_for_uploads_reads_no_database(service: Running) -> None:
    client = service.client(("upload",))
    acquisition = new_acquisition(client)
    answer: httpx.Response = send(client, acquisition, "cube", "../../specimap.db", b"x")
    assert answer.status_code == 201
    assert client.get(f"/v1/acquisitions/{acquisition}/files").status_code == 403

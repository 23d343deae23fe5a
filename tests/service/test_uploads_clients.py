"""Clients that others wrote: tuspy, and tus-js-client as a browser's page uses it."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tusclient.client import TusClient

from tests.support.places import SAMPLES, SUPPORT
from tests.support.service_scene import Running
from tests.support.upload_scene import BreakingProxy, new_acquisition, photos, result

JS_CLIENT = SUPPORT / "tus_client"


@pytest.mark.slow
@pytest.mark.parametrize("slash", ["", "/"])
@pytest.mark.parametrize("checksum", [False, True])
def test_tuspy_sends_a_photo_and_a_cube(service: Running, slash: str, checksum: bool) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    tus = TusClient(f"{service.url}/v1/uploads{slash}", headers={"Authorization": client.headers["Authorization"]})
    cube = SAMPLES / "hsi" / "hsi.hdr"
    for path, role in ((photos()[0], "photo"), (cube.with_suffix(".raw"), "cube"), (cube, "cube")):
        fields = {"acquisition": acquisition, "role": role, "filename": path.name}
        with open(path, "rb") as stream:
            uploader = tus.uploader(file_stream=stream, chunk_size=1_000_000, metadata=fields, upload_checksum=checksum)
            uploader.upload()
        described = result(client, str(uploader.url).removeprefix(service.url))
        assert described["file"]["judgement"]["verdict"] == "accepted"
        assert described["file"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    counts = client.get(f"/v1/acquisitions/{acquisition}").json()["files"]
    assert (counts["photos"], counts["cube"]) == (1, True)


@pytest.fixture(scope="module")
def js_client(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The JavaScript client, installed."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node and npm are not on this machine")
    folder = tmp_path_factory.mktemp("tus_client")
    for name in ("package.json", "package-lock.json", "upload.js"):
        shutil.copy(JS_CLIENT / name, folder / name)
    subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=folder, check=True, capture_output=True, timeout=180)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [0, 1_500_000])
def test_tus_js_client_goes_on_where_the_network_broke(
    service: Running, js_client: Path, chunk: int, tmp_path: Path
) -> None:
    data = np.random.default_rng(0).bytes(8_000_000)
    file = tmp_path / "cube.raw"
    file.write_bytes(data)
    client = service.client()
    acquisition = new_acquisition(client)
    proxy = BreakingProxy(service.url, breaks=3, most_bytes=2_000_000, seed=2)
    key = client.headers["Authorization"].removeprefix("Bearer ")
    try:
        done = subprocess.run(
            ["node", "upload.js", f"{proxy.url}/v1/uploads", acquisition, "cube", str(file), str(chunk)],
            cwd=js_client,
            env={**os.environ, "KEY": key},
            capture_output=True,
            text=True,
            timeout=60,
        )
    finally:
        proxy.close()
    assert done.returncode == 0, done.stdout + done.stderr
    output = json.loads(done.stdout)
    assert output["answers"][-1] == ["PATCH", 204, "accepted"]
    assert ["HEAD", 200, None] in output["answers"]
    assert proxy.cut == 3
    assert result(client, output["url"].removeprefix(proxy.url))["file"]["sha256"] == hashlib.sha256(data).hexdigest()

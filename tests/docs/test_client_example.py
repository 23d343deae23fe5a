"""The example and the guide for classifiers run, and the example labels as well as any classifier can."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray

import specimap_client as sc
from specimap_client._acquisitions import Acquisitions
from specimap_client._clouds import Clouds
from specimap_client._jobs import Jobs
from specimap_client._keys import Keys
from tests.support.client_scene import connect
from tests.support.cloud_scene import FakeCube, scene
from tests.support.places import ROOT
from tests.support.result_scene import put_result
from tests.support.service_scene import Running

EXAMPLE = ROOT / "client" / "examples" / "train_and_label.py"
README = ROOT / "client" / "README.md"
GUIDE = ROOT / "docs" / "classifier.md"
ROWS, COLS, BANDS = 60, 50, 16
STEP = 100.0
"""Half of the classes' difference in each band, stored counts."""
NOISE = 243.0


def specimen(seed: int) -> tuple[FakeCube, NDArray[np.uint8]]:
    """A cube of two tissues that differ less than their noise in every band, and the tissue (1, 2) of its pixels."""
    rng = np.random.default_rng(seed)
    tissue = 1 + (np.add.outer(np.arange(ROWS), np.arange(COLS)) // 10 % 2).astype(np.uint8)
    mean = 3000 + 1000 * np.sin(np.arange(BANDS) / 3)
    shift = np.where(tissue == 1, STEP, -STEP)[..., None] * np.resize([1.0, -1.0], BANDS)
    values = mean + shift + rng.normal(0, NOISE, (ROWS, COLS, BANDS))
    return FakeCube(values.round().astype(np.uint16), bad=(5,)), tissue


def test_example_labels_a_cloud_as_well_as_can_be(service: Running, tmp_path: Path) -> None:
    cubes = [specimen(1), specimen(2)]
    results = [
        put_result(service, tmp_path / str(i), cube=cube, points=scene(ROWS, COLS, 0.9, seed=i))
        for i, (cube, _) in enumerate(cubes)
    ]
    truth = [tissue[tuple(r.cloud.hsi_pixel.T)] for r, (_, tissue) in zip(results, cubes, strict=True)]
    classes = [(0, "unlabelled"), (1, "tumour", "#d62728"), (2, "healthy", "#2ca02c")]
    with connect(service) as client:
        seen = np.where(np.arange(len(truth[0])) % 2, truth[0], 0)
        client.clouds.get(results[0].cloud_id).put_label("histology", seen, classes=classes, made_by="a person")
        environment = os.environ | {
            "SPECIMAP_URL": service.url,
            "SPECIMAP_KEY": service.key(["read", "label"]),
            "NO_PROXY": "127.0.0.1",
        }
        command = [sys.executable, str(EXAMPLE), results[0].cloud_id, results[1].cloud_id]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        label = client.clouds.get(results[1].cloud_id).label("tissue")
        found = label.values()
    flags = results[1].cloud.flags
    on_tissue = (flags & 1 > 0) & (flags & 2 == 0)
    assert done.stdout.strip() == f"tissue, version 1: {on_tissue.sum()} of {len(flags)} points labelled"
    assert label.made_by["trained_on"] == results[0].cloud_id
    assert [(c.value, c.name) for c in label.classes] == [(0, "unlabelled"), (1, "tumour"), (2, "healthy")]
    np.testing.assert_array_equal(found > 0, on_tissue)
    # The best that any classifier reaches on two Gaussians of one covariance; the bad band is left out.
    best = NormalDist().cdf(STEP * np.sqrt(BANDS - 1) / NOISE)
    share = float((found == truth[1])[on_tissue].mean())
    deviation = np.sqrt(best * (1 - best) / on_tissue.sum())
    assert 0.93 < best < 0.96
    assert best - 0.02 - 3 * deviation < share < best + 3 * deviation


class Always:
    """A model that finds the same everywhere."""

    def predict(self, spectra: NDArray[np.float32]) -> NDArray[np.int64]:
        """Class 1 for each of (n, B)."""
        return np.ones(len(spectra), np.int64)


def test_guide_does_what_it_says(service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = put_result(service, tmp_path / "result")
    for name, value in (
        ("SPECIMAP_URL", service.url),
        ("SPECIMAP_KEY", service.key(["read", "label"])),
        ("NO_PROXY", "127.0.0.1"),
    ):
        monkeypatch.setenv(name, value)
    client_part, zarr_part = GUIDE.read_text("utf-8").split("## With a Zarr reader")
    names: dict[str, object] = {"cloud_id": result.cloud_id, "model": Always()}
    exec(compile("".join(blocks(client_part)), str(GUIDE), "exec"), names)
    with connect(service) as client:
        label = client.clouds.get(result.cloud_id).label("tissue")
        assert (label.version, label.made_by["name"]) == (2, "net-3d")
        on_tissue = label.values()
    flags = result.cloud.flags
    np.testing.assert_array_equal(on_tissue > 0, (flags & 1 > 0) & (flags & (2 | 8 | 32) == 0))
    by_zarr = blocks(zarr_part)[0].replace("OUT/", f"{result.local}/")
    exec(compile(by_zarr, str(GUIDE), "exec"), names)
    read = np.asarray(names["spectra"])
    np.testing.assert_allclose(read, result.cloud.spectra(np.flatnonzero(on_tissue), [0, 1, 3, 4, 5, 6]), rtol=1e-6)


def test_readme_names_what_there_is() -> None:
    text = README.read_text("utf-8")
    for block in blocks(text):
        compile(block, str(README), "exec")
    kinds = {"acquisitions": Acquisitions, "jobs": Jobs, "clouds": Clouds, "keys": Keys, "cloud": sc.Cloud}
    called = re.findall(r"\b(acquisitions|jobs|clouds|keys|cloud)\.(\w+)\(", text)
    assert len(called) > 10
    assert [f"{kind}.{name}" for kind, name in called if not hasattr(kinds[kind], name)] == []


def blocks(page: str) -> list[str]:
    """The Python programs of a page."""
    return re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)


def test_example_is_short() -> None:
    assert len(EXAMPLE.read_text("utf-8").splitlines()) < 40

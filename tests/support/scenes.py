"""Small scenes whose truth is known: marker layouts seen by noisy cameras, a phantom on disk, a finished run."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from specimap_cli.app import app
from specimap_core.arrays import Array, Floats
from specimap_core.bundle_adjust.solver import MarkerScene
from specimap_core.cloud import Cloud
from specimap_core.errors import StageFailedError
from specimap_core.fiducials.observations import Observations, corners_of
from specimap_core.geometry.cameras import Intrinsics, Pose, look_at, rotation_from_vector
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from specimap_core.surface.fusion import Mesh, vertex_normals
from specimap_core.truth.truth_file import Truth
from specimap_validation.phantom import PhantomSettings, load_truth, write_cube, write_phantom
from tests.support.shared_folders import SharedFolders

SMALL = PhantomSettings(photos=12, photo_size=384, cube_rows=128, cube_cols=160, bands=16, mesh_divisions=64)
TINY = replace(SMALL, photos=8, photo_size=320, mesh_divisions=40, cube_rows=96, cube_cols=120, bands=6)
EDGE_MM = 6.8
UNNAMED = {"internal_error", StageFailedError.code}
"""Codes of failures that no check foresaw."""


# ---- marker layouts without pictures ------------------------------------------------------------------


def marker_scene(
    *,
    photos: int = 10,
    markers: int = 4,
    noise_px: float = 0.1,
    seed: int = 0,
    lens: Intrinsics | None = None,
    tilt_deg: float = 0.0,
) -> tuple[MarkerScene, Observations]:
    """The truth of ``markers`` squares on a ring of 22 mm, and what ``photos`` cameras 150 mm away see of it."""
    rng = np.random.default_rng(seed)
    lens = lens or Intrinsics.centred(640, 480, 820.0)
    squares = []
    for k in range(markers):
        angle = 2 * np.pi * (k + rng.uniform(-0.15, 0.15)) / markers
        tilt = np.radians(tilt_deg) * rng.uniform(-1, 1, 2)
        turn = rotation_from_vector(np.array([*tilt, 0.0])) @ rotation_from_vector(
            np.array([0, 0, rng.uniform(0, 2 * np.pi)])
        )
        place = np.array([np.cos(angle), np.sin(angle), 0.0]) * 22.0
        squares.append(Pose(turn, place))
    poses = []
    for k in range(photos):
        azimuth = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / photos
        up = np.radians(rng.uniform(35, 70))
        eye = 150.0 * np.array([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)])
        poses.append(look_at(eye, rng.uniform(-2, 2, 3), np.array([0.0, 0, 1])))
    corners = corners_of(tuple(squares), EDGE_MM)
    photo, marker = (a.ravel() for a in np.indices((photos, markers)))
    scene = MarkerScene(lens, tuple(poses), corners, tuple(squares))
    blank = Observations(photo, marker, np.zeros((len(photo), 4, 2)), np.full(len(photo), max(noise_px, 0.02)))
    exact = scene.residuals(blank)
    seen = exact + noise_px * rng.standard_normal(exact.shape)
    return scene, Observations(photo, marker, seen, blank.sigma_px)


def bump_mesh(*, size_mm: float = 60.0, cell_mm: float = 0.5, height_mm: float = 10.0) -> Mesh:
    """A plane with a smooth bump of known height at the origin: :func:`bump_height`."""
    n = round(size_mm / cell_mm) + 1
    x, y = np.meshgrid(np.linspace(-size_mm / 2, size_mm / 2, n), np.linspace(-size_mm / 2, size_mm / 2, n))
    vertices = np.stack([x, y, bump_height(x, y, height_mm)], -1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + n], -1), np.stack([a + 1, a + n + 1, a + n], -1)])
    triangles = triangles.astype(np.int32)
    red = np.clip(128 + 4 * vertices[:, 0], 0, 255)
    colours = np.stack([red, np.full(len(red), 90.0), np.full(len(red), 30.0)], -1).astype(np.uint8)
    return Mesh(vertices, triangles, vertex_normals(vertices, triangles), colours)


def bump_height(x: Floats, y: Floats, height_mm: float = 10.0) -> Floats:
    """Height of the bump over x, y in mm."""
    return np.asarray(height_mm * np.exp(-(x**2 + y**2) / (2 * 7.0**2)))


def rotation_deg(a: Pose, b: Pose) -> float:
    """Angle between two orientations."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a.R.T @ b.R) - 1) / 2, -1, 1))))


# ---- a phantom on disk --------------------------------------------------------------------------------


@dataclass(frozen=True)
class OnDisk:
    """A phantom's folder with its truth."""

    folder: Path
    truth: Truth

    @property
    def photos(self) -> Path:
        """Folder of the photos."""
        return self.folder / "rgb"

    @property
    def header(self) -> Path:
        """The cube's header."""
        return self.folder / "hsi" / "hsi.hdr"

    def values(self) -> NDArray[np.uint16]:
        """The cube (rows, columns, bands)."""
        rows, cols = self.truth.hsi_class.shape
        flat = np.fromfile(self.header.with_suffix(".raw"), "<u2")
        return np.ascontiguousarray(flat.reshape(-1, rows, cols).transpose(1, 2, 0))


def phantom_on_disk(folder: Path, settings: PhantomSettings) -> OnDisk:
    """Write a phantom."""
    return OnDisk(folder, write_phantom(settings, folder))


def shared_phantom(shared_folders: SharedFolders, settings: PhantomSettings) -> OnDisk:
    """A phantom that is written once for all processes; nobody changes it."""
    folder = shared_folders.made("phantom", settings, lambda folder: write_phantom(settings, folder))
    return OnDisk(folder, load_truth(folder))


def cube_with(values: NDArray[np.uint16], like: OnDisk, folder: Path) -> Path:
    """Write an altered cube; returns its header."""
    folder.mkdir(parents=True, exist_ok=True)
    wavelengths = like.truth.wavelengths_nm[: values.shape[2]]
    write_cube(np.ascontiguousarray(values), wavelengths, folder / "hsi.hdr", interleave="bsq")
    return folder / "hsi.hdr"


@dataclass(frozen=True)
class Finished:
    """The output folder of a run, with its report."""

    out: Path
    report: Report

    def copy_to(self, folder: Path) -> Path:
        """A copy to run into again: its stages 1 and 2 are taken over."""
        shutil.copytree(self.out, folder)
        return folder


def shared_run(shared_folders: SharedFolders, acquisition: Path) -> Finished:
    """A run on a folder with ``rgb`` and ``hsi``, made once for all processes; copy it before running into it again."""
    inputs = Inputs(acquisition / "rgb", acquisition / "hsi" / "hsi.hdr")
    made = shared_folders.made(
        "run", acquisition, lambda folder: run_pipeline(inputs, folder / "out", PipelineSettings())
    )
    out = made / "out"
    return Finished(out, Report.model_validate_json((out / "report.json").read_text(encoding="utf-8")))


def read_corners(out: Path) -> tuple[list[int], Floats]:
    """Ids and corners (Q, 4, 3) of a run."""
    stored = json.loads((out / "corners.json").read_text(encoding="utf-8"))
    return [int(i) for i in stored], np.array(list(stored.values()), float)


def xyz_image(out: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    cloud = Cloud.open(out / "cloud.zarr")
    image = np.full((*shape, 3), np.nan, np.float32)
    pixels = cloud.hsi_pixel
    image[pixels[:, 0], pixels[:, 1]] = cloud.xyz
    return image


def assert_same_result(out: Path, other: Path) -> None:
    """Two runs on the same input: the same corners and spectra, the same places to a thousandth of a millimetre.

    Fusion shares its voxels among threads, which leaves the order of the mesh's vertices, and the last bits, open.
    """
    assert (out / "corners.json").read_bytes() == (other / "corners.json").read_bytes()
    clouds = [Cloud.open(folder / "cloud.zarr") for folder in (out, other)]
    shape = tuple(int(max(c.hsi_pixel[:, k].max() for c in clouds)) + 1 for k in (0, 1))
    places = [xyz_image(folder, (shape[0], shape[1])) for folder in (out, other)]
    known = [np.isfinite(p[..., 0]) for p in places]
    assert (known[0] == known[1]).mean() > 0.999
    apart = np.linalg.norm(places[0] - places[1], axis=-1)[known[0] & known[1]]
    assert np.percentile(apart, 99) < 1e-3


# ---- the command line ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Answer:
    """What the command line said."""

    status: int
    out: str
    err: str

    @property
    def events(self) -> list[dict[str, object]]:
        """The lines of ``--json``."""
        return [json.loads(line) for line in self.out.splitlines()]

    @property
    def refusal(self) -> dict[str, object]:
        """The event that says why."""
        (event,) = [e for e in self.events if e["event"] == "refused"]
        return event


def specimap(*arguments: object) -> Answer:
    """Run the command line in this process."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert "Traceback" not in result.output
    return Answer(result.exit_code, result.stdout, result.stderr)


def run_refused(photos: Path, cube: Path, out: Path, *options: object) -> dict[str, object]:
    """Run and expect a refusal: exit status 2 with a code and an advice, which it returns."""
    answer = specimap("run", "--photos", photos, "--cube", cube, "--out", out, "--json", *options)
    assert answer.status == 2, answer
    refusal = answer.refusal
    assert refusal["message"]
    assert refusal["advice"]
    return refusal


def tree_of(folder: Path) -> dict[str, bytes]:
    """All files of a folder with their content, the mark and the stages left out."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and "stages" not in p.parts
    }


def as_array(values: object) -> Array:
    """A JSON list as an array."""
    return np.asarray(values)


# ---- fixtures -----------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def small(shared_folders: SharedFolders) -> OnDisk:
    """A small phantom."""
    return shared_phantom(shared_folders, SMALL)


@pytest.fixture(scope="session")
def other(shared_folders: SharedFolders) -> OnDisk:
    """Another specimen in another layout of markers with the same ids."""
    return shared_phantom(shared_folders, replace(SMALL, seed=2, bands=4))


@pytest.fixture(scope="session")
def tiny(shared_folders: SharedFolders) -> OnDisk:
    """Eight small photos and a cube of few bands."""
    return shared_phantom(shared_folders, TINY)


@pytest.fixture(scope="session")
def finished(shared_folders: SharedFolders, small: OnDisk) -> Finished:
    """One whole run on the small phantom; copy it before running into it again."""
    return shared_run(shared_folders, small.folder)

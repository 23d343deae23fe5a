"""Places that are hidden: from the cube's camera, or under other tissue, as flagged and as the true mesh has them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from specimap_core.arrays import Flags, Floats
from specimap_core.cloud import Cloud, Flag
from specimap_core.geometry.cameras import fit_similarity
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.register.settings import Method, RegisterSettings
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.raycast import RayCaster
from specimap_core.truth.truth_file import Truth, save_truth
from specimap_validation.phantom import Phantom, PhantomSettings, load_truth, write_cube
from specimap_validation.phantom.specimen import TRAY_Z_MM
from tests.support.scenes import OnDisk, shared_phantom, shared_run, xyz_image
from tests.support.shared_folders import SharedFolders

pytestmark = pytest.mark.slow

SEEDS = (3, 22)
TILTED_DEG, UPRIGHT_DEG = 12.0, PhantomSettings().hsi_tilt_deg
OFF_MM = 0.02
"""How far off the true surface a ray to what hides a place starts: beyond rounding, and no more."""
TRAY_HALF_MM = 60.0
SHARE = 0.9
"""Of ten flagged pixels nine are rightly so, and of ten hidden ones nine are flagged, within a pixel: who drops or
keeps points by a flag must be able to believe it."""
METHODS: tuple[Method, ...] = ("camera", "homography")


@dataclass(frozen=True)
class Hidden:
    """Pixels of a cube (rows, cols) with a point: those ``flagged``, and those whose place is hidden in ``truth``."""

    placed: Flags
    flagged: Flags
    truth: Flags


def settings(seed: int, tilt_deg: float) -> PhantomSettings:
    return PhantomSettings(seed=seed, hsi_tilt_deg=tilt_deg, bands=4)


def runs(shared_folders: SharedFolders, tilt_deg: float) -> dict[Method, list[Hidden]]:
    """Each specimen's photos with a cube at this tilt, by both methods."""
    return {method: [run(shared_folders, seed, tilt_deg, method) for seed in SEEDS] for method in METHODS}


def run(shared_folders: SharedFolders, seed: int, tilt_deg: float, method: Method) -> Hidden:
    """One of them. Where the cube stands does not change the photos, so their run is taken over."""
    written = shared_phantom(shared_folders, settings(seed, TILTED_DEG))
    first = shared_run(shared_folders, written.folder)
    if (tilt_deg, method) == (TILTED_DEG, "camera"):
        return judged(first.out, written.truth, method)
    cube = written if tilt_deg == TILTED_DEG else shared_cube(shared_folders, settings(seed, tilt_deg))

    def go_on(folder: Path) -> None:
        out = first.copy_to(folder / "out")
        report = run_pipeline(
            Inputs(written.photos, cube.header), out, PipelineSettings(register=RegisterSettings(method))
        )
        assert report.reused_stages == ["reconstruct", "adjust", "render"]

    made = shared_folders.made("hidden", (seed, tilt_deg, method), go_on)
    return judged(made / "out", cube.truth, method)


def shared_cube(shared_folders: SharedFolders, settings: PhantomSettings) -> OnDisk:
    """A phantom's cube without its photos, written once for all processes."""

    def write(folder: Path) -> None:
        phantom = Phantom(settings)
        write_cube(phantom.cube(), settings.wavelengths_nm, folder / "hsi" / "hsi.hdr", interleave="bsq")
        save_truth(phantom.truth, folder / "truth.npz")

    folder = shared_folders.made("cube", settings, write)
    return OnDisk(folder, load_truth(folder))


@pytest.fixture(scope="module")
def tilted(shared_folders: SharedFolders) -> dict[Method, list[Hidden]]:
    """A cube that looks under the overhang on one side."""
    return runs(shared_folders, TILTED_DEG)


@pytest.fixture(scope="module")
def upright(shared_folders: SharedFolders) -> dict[Method, list[Hidden]]:
    """A cube from straight above, or nearly."""
    return runs(shared_folders, UPRIGHT_DEG)


# ---- truth --------------------------------------------------------------------------------------------


def true_surface(truth: Truth) -> RayCaster:
    """The specimen's true mesh on the tray."""
    h, n = TRAY_HALF_MM, len(truth.vertices)
    tray = np.array([[-h, -h], [h, -h], [h, h], [-h, h]])
    vertices = np.concatenate([truth.vertices, np.c_[tray, np.full(4, TRAY_Z_MM)]]).astype(np.float32)
    triangles = np.concatenate([truth.triangles, [[n, n + 1, n + 2], [n, n + 2, n + 3]]]).astype(np.int32)
    return RayCaster(Mesh(vertices, triangles, np.zeros_like(vertices), np.zeros(vertices.shape, np.uint8)))


def behind_tissue(out: Path, truth: Truth) -> Flags:
    """Points (S,) of the cloud over which the true surface, seen from above, is hidden from the cube's true camera."""
    corners = json.loads((out / "corners.json").read_text(encoding="utf-8"))
    found = np.array([corners[str(i)] for i in truth.marker_ids]).reshape(-1, 3)
    _, R, t = fit_similarity(found, truth.marker_corners.reshape(-1, 3))
    surface = true_surface(truth)
    above = Cloud.open(out / "cloud.zarr").xyz.astype(float) @ R.T + t
    above[:, 2] = truth.vertices[:, 2].max() + 1
    place = surface.cast(above, vertical(above, -1)).xyz.astype(float)
    away = truth.hsi_view.cam_from_world.centre - place
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return surface.cast(place + OFF_MM * away, away).hit


def under_tissue(out: Path, truth: Truth) -> Flags:
    """Points (S,) of the cloud whose pixels truly look at places with tissue above."""
    pixels = Cloud.open(out / "cloud.zarr").hsi_pixel
    place = truth.hsi_xyz[pixels[:, 0], pixels[:, 1]].astype(float)
    up = vertical(place, 1)
    return true_surface(truth).cast(place + OFF_MM * up, up).hit


def vertical(points: Floats, z: float) -> Floats:
    return np.broadcast_to([0.0, 0.0, z], points.shape)


def judged(out: Path, truth: Truth, method: Method) -> Hidden:
    """A run by ``method`` against truth: what that method flags."""
    flag, hidden_in = (Flag.UNDERCUT, under_tissue) if method == "camera" else (Flag.OCCLUDED, behind_tissue)
    hidden = hidden_in(out, truth)
    cloud = Cloud.open(out / "cloud.zarr")
    pixels, shape = cloud.hsi_pixel, truth.hsi_class.shape

    def image(values: Flags) -> Flags:
        drawn = np.zeros(shape, bool)
        drawn[pixels[:, 0], pixels[:, 1]] = values
        return drawn

    return Hidden(np.isfinite(xyz_image(out, shape)[..., 0]), image((cloud.flags & flag) > 0), image(hidden))


# ---- precision and recall -----------------------------------------------------------------------------


def precision_recall(found: list[Hidden], within_px: int) -> tuple[float, float]:
    """Share of flagged pixels near a hidden one, and of hidden pixels near a flagged one, over all specimens.

    Together, since one specimen has a few hundred such pixels, and those of one fold stand or fall together.
    """
    reach = np.ones((2 * within_px + 1,) * 2, np.uint8)

    def share(of: str, near: str) -> float:
        hits = sum(
            int((getattr(h, of) & (cv2.dilate(getattr(h, near).astype(np.uint8), reach) > 0)).sum()) for h in found
        )
        return hits / sum(int(getattr(h, of).sum()) for h in found)

    return share("flagged", "truth"), share("truth", "flagged")


def check(found: list[Hidden]) -> None:
    near = precision_recall(found, 1)
    # All would be right only if truth were what was flagged.
    assert SHARE <= near[0] < 1, near
    assert SHARE <= near[1] < 1, near
    exact = precision_recall(found, 0)
    assert all(share < within for share, within in zip(exact, near, strict=True))
    # By chance a flagged pixel is hidden as often as any pixel is.
    chance = sum(h.truth.sum() for h in found) / sum(h.placed.sum() for h in found)
    assert 0 < chance < 0.02
    assert min(exact) > 10 * chance, (exact, chance)


def test_hidden_places_are_flagged_where_the_cube_looks_aslant(tilted: dict[Method, list[Hidden]]) -> None:
    check(tilted["homography"])


def test_undercut_places_are_flagged_where_the_cube_looks_aslant(tilted: dict[Method, list[Hidden]]) -> None:
    check(tilted["camera"])


def test_hidden_places_are_flagged_from_above(upright: dict[Method, list[Hidden]]) -> None:
    check(upright["homography"])


def test_from_above_hardly_anything_is_undercut(
    tilted: dict[Method, list[Hidden]], upright: dict[Method, list[Hidden]]
) -> None:
    for aslant, straight in zip(tilted["camera"], upright["camera"], strict=True):
        assert straight.flagged.sum() < 0.05 * aslant.flagged.sum()
        assert straight.truth.sum() < 0.05 * aslant.truth.sum()

"""Path-traced phantoms: their parts that need no renderer, and ``specimap phantom``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from specimap_cli.app import app
from specimap_core.errors import BackendUnavailableError, SettingsError
from specimap_core.geometry.pushbroom import ScanView
from specimap_validation.path_traced import renderer
from specimap_validation.path_traced.cards import bent_cards
from specimap_validation.path_traced.cube import shift_bands
from specimap_validation.path_traced.optics import optics_of
from specimap_validation.path_traced.photo import develop
from specimap_validation.path_traced.scan import UnevenScan
from specimap_validation.path_traced.settings import PRESETS, preset
from specimap_validation.path_traced.specimen import folded_specimen
from specimap_validation.phantom import PhantomSettings, write_phantom
from specimap_validation.phantom.scene import place_cards
from specimap_validation.phantom.views import hsi_view, photo_views
from tests.support.traced_scene import TINY

# ---- what needs no renderer ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_each_preset_has_settings_of_its_own(name: str) -> None:
    settings = preset(name, 3)
    assert settings.seed == 3
    assert 20 <= settings.photos * settings.thinned <= 30
    assert preset(name, 4).specimen_mm != settings.specimen_mm
    assert sum(preset(other, 3) == settings for other in PRESETS) == 1


def test_half_is_every_second_photo_of_blurred() -> None:
    half, blurred = preset("half", 5), preset("blurred", 5)
    whole = photo_views(blurred)
    round_of = photo_views(replace(half, photos=half.photos * half.thinned))
    for a, b in zip(whole, round_of, strict=True):
        np.testing.assert_array_equal(a.cam_from_world.matrix, b.cam_from_world.matrix)


@pytest.mark.parametrize(
    "change",
    [
        {"samples": 0},
        {"coat_roughness": 0.0},
        {"quality": (92, 85)},
        {"covered": (9,)},
        {"photos": 0},
        {"bare_photos": (0,)},
        {"motion_px": float("nan")},
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(SettingsError) as refused:
        replace(TINY, **change)  # type: ignore[arg-type]
    assert refused.value.details["setting"] == next(iter(change))


def test_an_unknown_preset_or_seed_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"blurry.*Use clean"):
        preset("blurry", 1)
    with pytest.raises(SettingsError, match="seed is -1"):
        preset("clean", -1)


def test_the_specimen_has_the_stated_size_and_folds_over_itself() -> None:
    specimen = folded_specimen(replace(TINY, mesh_divisions=64))
    low, high = specimen.vertices.min(0), specimen.vertices.max(0)
    assert (high - low)[:2] == pytest.approx([33, 28])
    assert high[2] - -0.2 == pytest.approx(14)
    above = specimen.vertices[:, 2] > 1
    assert (specimen.normals[above, 2] < -0.1).mean() > 0.05
    assert specimen.abundance.sum(1) == pytest.approx(1)
    assert specimen.abundance.min() >= 0


def test_cards_are_bent_by_as_much_as_stated_and_else_where_quick_ones_are() -> None:
    flat = bent_cards(TINY)
    np.testing.assert_allclose(flat.corners, place_cards(TINY).corners, atol=1e-12)
    bent = bent_cards(replace(TINY, card_bend_mm=0.1))
    heights = bent.vertices.reshape(4, -1, 3)[..., 2]
    # Across corners, a bend reaches twice as far as along an edge.
    assert (np.ptp(heights, axis=1) > 0.04).all()
    assert (np.ptp(heights, axis=1) < 0.21).all()
    corner = bent.corners[:, :, None] - bent.vertices.reshape(4, 1, -1, 3)
    assert np.linalg.norm(corner, axis=3).min(2).max() == 0


def test_an_uneven_stage_is_early_and_late_about_an_even_one() -> None:
    even = hsi_view(replace(TINY, cube_scan="rows"))
    assert isinstance(even, ScanView)
    lines = TINY.cube_rows
    early = np.zeros(lines)
    early[7] = 0.25
    motion = even.scan, even.skew, even.climb, even.depth_mm
    uneven = UnevenScan(even.intrinsics, even.cam_from_world, *motion, 0.01, tuple(early))
    pixels = np.stack([np.full(lines, 20.0), np.arange(lines)], 1)
    ahead = (uneven.origins(pixels) - even.origins(pixels)) @ even.cam_from_world.R[1] * even.step_px
    drift = ahead - early
    assert drift.mean() == pytest.approx(0, abs=0.01)
    # The speed, which is the slope, rises by 1 % from the first line to the last.
    slope = np.diff(drift)
    assert slope[-1] - slope[0] == pytest.approx(0.01, rel=0.05)


def test_bands_shift_by_at_most_what_is_stated_and_the_middle_one_not() -> None:
    h, w, sd = 80, 100, 4.0
    col, row = np.meshgrid(np.arange(w), np.arange(h))
    spots = [np.exp(-((col - x) ** 2 + (row - y) ** 2) / (2 * sd**2)) for x, y in ((15, 15), (84, 64))]
    for spot, (x, y) in zip(spots, ((15, 15), (84, 64)), strict=True):
        cube = np.repeat(spot[..., None], 5, 2).astype(np.float32)
        shift_bands(cube, 0.5, np.random.default_rng(1))
        weight = cube.sum((0, 1))
        found = np.stack([np.tensordot(a, cube, 2) / weight for a in (col, row)], 1) - (x, y)
        assert abs(found[2]) == pytest.approx([0, 0], abs=1e-3)
        assert 0.1 < np.linalg.norm(found[0]) < 0.5 * 2**0.5
        np.testing.assert_allclose(found[0], -found[4], atol=0.02)


def test_a_photo_is_exposed_balanced_and_noisy_as_set() -> None:
    grey = np.full((64, 64, 3), 0.25, np.float32)
    still = develop(TINY, grey, np.random.default_rng(0))
    assert np.ptp(still) == 0
    noisy = develop(replace(TINY, noise=0.02), grey, np.random.default_rng(0)).astype(float)
    assert 255 * 0.02 < noisy.std() < 255 * 0.03  # sRGB is steeper than 1 there
    tinted = develop(replace(TINY, white_balance_spread=0.1), grey, np.random.default_rng(0))[0, 0]
    assert tinted[1] == still[0, 0, 1]
    assert (tinted[[0, 2]] != still[0, 0, [0, 2]]).all()


def test_a_still_hand_and_a_pinhole_spread_no_rays() -> None:
    view = photo_views(TINY)[0]
    optics = optics_of(TINY, view, np.random.default_rng(0))
    assert optics.aperture_mm == 0
    assert not optics.turn.any()
    moved = optics_of(replace(TINY, motion_px=2.0), view, np.random.default_rng(0))
    assert np.linalg.norm(moved.turn) * view.intrinsics.focal_px == pytest.approx(2, rel=1)
    # A turn about the optical axis would not move the middle of the picture.
    assert moved.turn @ view.cam_from_world.R[2] == pytest.approx(0, abs=1e-12)


def test_what_is_missing_is_named_with_advice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(renderer, "find_spec", lambda name: None)
    with pytest.raises(BackendUnavailableError, match="make path-traced"):
        renderer.start_renderer()
    answer = CliRunner().invoke(app, ["phantom", "--out", str(tmp_path / "p"), "--path-traced"])
    assert answer.exit_code == 2
    assert "backend_unavailable" in answer.stderr
    assert not (tmp_path / "p").exists()


# ---- the command --------------------------------------------------------------------------------------


def test_the_command_writes_a_quick_phantom(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    small = PhantomSettings(photos=1, photo_size=64, cube_rows=32, cube_cols=40, bands=3, mesh_divisions=8)
    monkeypatch.setattr("specimap_validation.phantom.PhantomSettings", lambda seed: replace(small, seed=seed))
    out = tmp_path / "p"
    answer = CliRunner().invoke(app, ["phantom", "--out", str(out), "--seed", "6", "--json"])
    assert answer.exit_code == 0
    assert '"event":"written"' in answer.stdout.replace(" ", "")
    write_phantom(replace(small, seed=6), tmp_path / "same")
    assert (out / "truth.npz").read_bytes() == (tmp_path / "same" / "truth.npz").read_bytes()
    again = CliRunner().invoke(app, ["phantom", "--out", str(out)])
    assert again.exit_code == 2
    assert "is not empty" in again.stderr


@pytest.mark.parametrize(
    ("options", "said"),
    [(["--preset", "clean"], "Add --path-traced"), (["--path-traced", "--preset", "x"], "pushbroom")],
)
def test_the_command_refuses_a_preset_that_it_cannot_use(tmp_path: Path, options: list[str], said: str) -> None:
    answer = CliRunner().invoke(app, ["phantom", "--out", str(tmp_path / "p"), *options])
    assert answer.exit_code == 2
    assert said in answer.stderr

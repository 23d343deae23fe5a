"""Synthetic specimens: their truth is exact and survives its file, and a seed repeats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from specimap_core.errors import NotFoundError, SettingsError, UnknownDictionaryError
from specimap_validation.phantom import MATERIALS, Phantom, build_scene, endmembers, load_truth, write_phantom
from specimap_validation.phantom.specimen import build_specimen, cube_sphere
from tests.support.scenes import SMALL

TINY = replace(SMALL, photos=2, photo_size=96, cube_rows=48, cube_cols=64, bands=5, mesh_divisions=16)


def test_the_specimen_has_the_stated_size_and_overhangs() -> None:
    specimen = build_specimen(SMALL)
    low, high = specimen.vertices.min(0), specimen.vertices.max(0)
    assert (high - low)[:2] == pytest.approx([33, 28])
    assert high[2] - -0.2 == pytest.approx(14)
    assert low[2] < -0.2
    above_tray = specimen.vertices[:, 2] > 1
    overhang = (specimen.normals[:, 2] < -0.1) & above_tray
    assert 0.01 < overhang.sum() / above_tray.sum() < 0.4
    assert specimen.abundance.sum(1) == pytest.approx(1)
    assert specimen.abundance.min() >= 0


def test_the_cube_sphere_is_closed_and_wound_outward() -> None:
    points, triangles = cube_sphere(5)
    assert points.shape == (6 * 25 + 2, 3)
    assert triangles.shape == (12 * 25, 3)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0).all()
    edges = {(int(p), int(q)) for t in triangles for p, q in zip(t, np.roll(t, -1), strict=True)}
    assert {(q, p) for p, q in edges} == edges


def test_a_seed_repeats_and_another_differs(tmp_path: Path) -> None:
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        write_phantom(replace(TINY, seed=seed), tmp_path / name)
    files = sorted(f.relative_to(tmp_path / "a") for f in (tmp_path / "a").rglob("*") if f.is_file())
    assert [str(f) for f in files] == [
        "hsi/hsi.hdr",
        "hsi/hsi.raw",
        "rgb/view_000.jpg",
        "rgb/view_001.jpg",
        "truth.npz",
    ]
    for file in files:
        first, again, other = ((tmp_path / k / file).read_bytes() for k in "abc")
        assert first == again
        assert (first == other) == (file.suffix == ".hdr")


@pytest.mark.slow
@pytest.mark.parametrize(("interleave", "axes"), [("bsq", (1, 2, 0)), ("bil", (0, 2, 1)), ("bip", (0, 1, 2))])
def test_the_cube_is_written_as_its_header_says(tmp_path: Path, interleave: str, axes: tuple[int, int, int]) -> None:
    write_phantom(TINY, tmp_path, interleave=interleave, photo_format="png")
    header = (tmp_path / "hsi" / "hsi.hdr").read_text()
    assert f"interleave = {interleave}" in header
    cube = Phantom(TINY).cube()
    shape = {"bsq": (5, 48, 64), "bil": (48, 5, 64), "bip": (48, 64, 5)}[interleave]
    stored = np.fromfile(tmp_path / "hsi" / "hsi.raw", "<u2").reshape(shape)
    np.testing.assert_array_equal(stored.transpose(axes), cube)
    _, image = next(Phantom(TINY).photos())
    read = np.asarray(cv2.imread(str(tmp_path / "rgb" / "view_000.png"), cv2.IMREAD_COLOR_RGB))
    np.testing.assert_array_equal(read, image)


def test_the_truth_survives_its_file(tmp_path: Path) -> None:
    settings = replace(TINY, k1=-0.05, k2=0.01, card_tilt_deg=2, card_lift_mm=0.5, dead_pixel_fraction=0.01)
    written = write_phantom(settings, tmp_path, photo_format="png")
    read = load_truth(tmp_path)
    assert read.photo_names == written.photo_names == ["rgb/view_000.png", "rgb/view_001.png"]
    for a, b in zip([*read.views, read.hsi_view], [*written.views, written.hsi_view], strict=True):
        assert a.intrinsics == b.intrinsics
        np.testing.assert_array_equal(a.cam_from_world.matrix, b.cam_from_world.matrix)
    for name in (
        "marker_ids",
        "marker_corners",
        "hsi_xyz",
        "hsi_class",
        "endmembers",
        "dead_pixels",
        "triangles",
    ):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_allclose(read.abundance, written.abundance, atol=5e-4)
    np.testing.assert_allclose(read.vertices, written.vertices, atol=1e-5)


def test_spectra_mix_as_the_abundance_says() -> None:
    phantom = Phantom(replace(TINY, cube_noise=0, texture_contrast=0))
    truth, cube = phantom.truth, phantom.cube() / 10000
    mixed = truth.abundance @ truth.endmembers
    # Only the light's strength is left between them: the directions of the spectra agree.
    cosine = (mixed * cube).sum(2) / np.linalg.norm(mixed, axis=2) / np.linalg.norm(cube, axis=2)
    assert cosine.min() > 0.9999
    assert truth.abundance.sum(2) == pytest.approx(1, abs=1e-5)


def test_endmembers_are_reflectances_and_differ() -> None:
    curves = endmembers(np.linspace(400, 1700, 64))
    assert curves.shape == (len(MATERIALS), 64)
    assert curves.min() > 0
    assert curves.max() < 1
    unit = curves / np.linalg.norm(curves, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(unit @ unit.T, -1, 1)))[:4, :4]
    # Noise of 0.005 on a mean of 0.3 turns a spectrum by 1 degree: the tissues must lie farther apart.
    assert angle[~np.eye(4, dtype=bool)].min() > 3


def test_bad_bands_and_dead_pixels_are_where_the_truth_says() -> None:
    phantom = Phantom(replace(TINY, bands=20, bad_band_fraction=0.1, dead_pixel_fraction=0.005))
    truth, cube = phantom.truth, phantom.cube()
    assert len(truth.bad_bands) == 2
    assert len(truth.dead_pixels) == round(0.005 * 48 * 64)
    assert (cube[tuple(truth.dead_pixels.T)] == 0).all()
    tray = cube[truth.hsi_class == 3].astype(float)
    assert np.isin(truth.bad_bands, np.argsort(tray.std(0) / tray.mean(0))[-2:]).all()


def test_cards_are_tilted_and_lifted_clear_of_the_tray() -> None:
    settings = replace(TINY, marker_ids=tuple(range(12)), card_tilt_deg=3, card_lift_mm=0.5)
    cards = build_scene(settings).cards
    assert cards.outlines[..., 2].min() > -0.2
    assert 0.1 < cards.corners[..., 2].std() < 0.5
    edges = np.linalg.norm(np.roll(cards.corners, -1, 1) - cards.corners, axis=2)
    assert edges == pytest.approx(6.8)
    centres = cards.corners.mean(1)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    assert apart[~np.eye(12, dtype=bool)].min() > settings.card_mm * 2**0.5


@pytest.mark.parametrize(
    "change",
    [
        {"photos": 0},
        {"edge_mm": 0.0},
        {"marker_ids": ()},
        {"marker_ids": (1, 1)},
        {"noise": -1.0},
        {"wavelength_nm": (900.0, 400.0)},
        {"specimen_mm": (0.0, 20.0, 10.0)},
        {"noise": float("nan")},
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(SettingsError) as refused:
        replace(SMALL, **change)  # type: ignore[arg-type]
    assert refused.value.details["setting"] == next(iter(change))


def test_unknown_markers_and_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownDictionaryError):
        build_scene(replace(TINY, dictionary="DICT_4X4_51"))
    with pytest.raises(SettingsError, match="no marker 50"):
        build_scene(replace(TINY, marker_ids=(50,)))
    with pytest.raises(SettingsError, match="bup"):
        write_phantom(TINY, tmp_path, interleave="bup")
    with pytest.raises(SettingsError, match="gif"):
        write_phantom(TINY, tmp_path, photo_format="gif")
    with pytest.raises(NotFoundError):
        load_truth(tmp_path)


@pytest.mark.parametrize("content", [b"", b"# a page of text", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_truth_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "truth.npz"
    path.write_bytes(content)
    with pytest.raises(NotFoundError, match="is not a phantom's truth"):
        load_truth(path)


def test_arrays_of_something_else_are_no_truth(tmp_path: Path) -> None:
    np.savez(tmp_path / "truth.npz", depth=np.zeros(3))
    with pytest.raises(NotFoundError, match="is not a phantom's truth"):
        load_truth(tmp_path)

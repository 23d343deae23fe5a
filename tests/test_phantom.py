"""Synthetic specimens: their truth is exact, their pictures are what the truth says, and a seed repeats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap.core.errors import NotFoundError, SettingsError, UnknownDictionaryError
from specimap.core.geometry import Floats, Intrinsics, View, look_at
from specimap.core.phantom import (
    MATERIALS,
    Paint,
    Phantom,
    PhantomSettings,
    build_scene,
    endmembers,
    load_truth,
    render_view,
    write_phantom,
)
from specimap.core.phantom.materials import BLACK_INK
from specimap.core.phantom.specimen import build_specimen, cube_sphere

SMALL = PhantomSettings(
    photos=12, photo_size=384, cube_rows=128, cube_cols=160, bands=16, mesh_divisions=64
)  # fmt: skip
TINY = replace(SMALL, photos=2, photo_size=96, cube_rows=48, cube_cols=64, bands=5, mesh_divisions=16)


@pytest.fixture(scope="module")
def phantom() -> Phantom:
    return Phantom(SMALL)


@pytest.fixture(scope="module")
def photos(phantom: Phantom) -> list[NDArray[np.uint8]]:
    return [image for _, image in phantom.photos()]


def detect(gray: NDArray[np.uint8]) -> dict[int, Floats]:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(gray)
    if ids is None:
        return {}
    return {int(i): c[0].astype(float) for i, c in zip(ids.ravel(), corners, strict=True)}


def area(polygon: Floats) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


def test_markers_are_detected_where_the_truth_projects_them(
    phantom: Phantom, photos: list[NDArray[np.uint8]]
) -> None:
    errors, seen = [], 0
    for image, view in zip(photos, phantom.truth.views, strict=True):
        found = detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
        seen += len(found) >= 3
        for marker_id, corners in found.items():
            true = view.project(phantom.truth.marker_corners[marker_id])
            distance = np.linalg.norm(corners[:, None] - true[None], axis=2)
            assert distance.argmin(1).tolist() == [0, 1, 2, 3]  # the order of the corners
            errors.append(np.diag(distance))
    assert seen >= 9
    assert tuple(phantom.truth.marker_ids) == SMALL.marker_ids
    assert 0.05 < float(np.median(errors)) < 1.0  # an unrefined detector is coarse, yet not coarser


def test_markers_are_detected_in_the_cube(phantom: Phantom) -> None:
    mean = phantom.cube().mean(2) / 10000 * 255
    enlarged = cv2.resize(
        np.clip(mean, 0, 255).astype(np.uint8), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC
    )
    found = detect(np.asarray(enlarged, np.uint8))
    assert sorted(found) == list(SMALL.marker_ids)
    for marker_id, corners in found.items():
        true = phantom.truth.hsi_view.project(phantom.truth.marker_corners[marker_id])
        assert np.linalg.norm((corners + 0.5) / 3 - 0.5 - true, axis=1).max() < 1.0


def test_marker_edges_are_unbiased(phantom: Phantom) -> None:
    # The ink's own channel holds each pixel's share of ink: their sum is the area of the black cells.
    ink = np.zeros((len(MATERIALS), 1))
    ink[BLACK_INK] = 1
    paint = Paint.of(phantom.scene, ink, shading=0)
    cards = phantom.scene.cards
    centre = cards.corners[0].mean(0)
    view = View(
        Intrinsics.centred(200, 200, 900.0),
        look_at(centre + np.array([20.0, -40, 90]), centre, np.array([0, 0, 1.0])),
    )
    n = cards.white.shape[1]
    share = np.arange(n + 1) / n
    top_left, top_right, _, bottom_left = cards.corners[0]
    lattice = (
        top_left
        + share[:, None, None] * (bottom_left - top_left)
        + share[None, :, None] * (top_right - top_left)
    )
    cells = view.project(lattice)
    black = sum(
        area(np.stack([cells[r, c], cells[r, c + 1], cells[r + 1, c + 1], cells[r + 1, c]]))
        for r, c in np.argwhere(~cards.white[0])
    )
    image = render_view(phantom.scene, view, paint).image[..., 0]
    # 0.1 % of the area is 0.01 px on the edge of a marker of 60 px.
    assert image.sum() == pytest.approx(black, rel=1e-3)
    assert 0 < np.count_nonzero((image > 0) & (image < 1)) < 0.2 * image.size


def test_each_cube_pixel_sees_its_own_point(phantom: Phantom) -> None:
    truth = phantom.truth
    rows, cols = np.indices(truth.hsi_class.shape)
    pixels = truth.hsi_view.project(truth.hsi_xyz.astype(float))
    assert np.abs(pixels - np.stack([cols, rows], -1)).max() < 1e-3
    assert truth.hsi_xyz[truth.hsi_class == 3][:, 2] == pytest.approx(-0.2, abs=1e-3)
    assert truth.hsi_xyz[truth.hsi_class == 2][:, 2] == pytest.approx(0.0, abs=1e-3)


def test_classes_cover_what_the_specimen_and_the_cards_cover(phantom: Phantom) -> None:
    truth = phantom.truth
    mm2 = (400 / truth.hsi_view.intrinsics.focal_px) ** 2
    specimen, cards = ((truth.hsi_class == k).sum() * mm2 for k in (1, 2))
    assert cards == pytest.approx(4 * SMALL.card_mm**2, rel=0.03)
    assert 0.75 < specimen / (np.pi / 4 * 33 * 28) < 1.15
    assert not np.isin(truth.hsi_class, (0, 4)).any()


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


def test_photos_show_fine_contrast_on_the_specimen(phantom: Phantom, photos: list[NDArray[np.uint8]]) -> None:
    paint = Paint.of(phantom.scene, np.ones((len(MATERIALS), 1)))
    view, image = phantom.views[0], photos[0]
    on = render_view(phantom.scene, view, paint).classes == 1
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    local = np.sqrt(np.maximum(cv2.blur(gray**2, (7, 7)) - cv2.blur(gray, (7, 7)) ** 2, 0))
    noise = SMALL.noise * 255
    assert (local[on] > 3 * noise).mean() > 0.9
    assert on.mean() > 0.05


def test_cameras_stand_all_around_and_a_few_above(phantom: Phantom) -> None:
    centres = np.stack([v.cam_from_world.centre for v in phantom.views])
    directions = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(directions[:, 2]))
    assert elevation.min() > 28
    assert 1 <= (elevation > 68).sum() <= 3
    azimuth = np.sort(np.arctan2(centres[:, 1], centres[:, 0]))
    assert np.degrees(np.diff(azimuth, append=azimuth[0] + 2 * np.pi)).max() < 60


def test_a_seed_repeats_and_another_differs(tmp_path: Path) -> None:
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        write_phantom(replace(TINY, seed=seed), tmp_path / name)
    files = sorted(f.relative_to(tmp_path / "a") for f in (tmp_path / "a").rglob("*") if f.is_file())
    assert [str(f) for f in files] == [
        "hsi/hsi.hdr", "hsi/hsi.raw", "rgb/view_000.jpg", "rgb/view_001.jpg", "truth.npz",
    ]  # fmt: skip
    for file in files:
        first, again, other = ((tmp_path / k / file).read_bytes() for k in "abc")
        assert first == again
        assert (first == other) == (file.suffix == ".hdr")


@pytest.mark.parametrize(("interleave", "axes"), [("bsq", (1, 2, 0)), ("bil", (0, 2, 1)), ("bip", (0, 1, 2))])
def test_the_cube_is_written_as_its_header_says(
    tmp_path: Path, interleave: str, axes: tuple[int, int, int]
) -> None:
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


def test_lens_distortion_is_in_the_photo() -> None:
    settings = replace(
        SMALL, photos=1, k1=-0.25, k2=0.1, marker_ids=(5,), mesh_divisions=16, specimen_mm=(8, 8, 4)
    )
    phantom = Phantom(settings)
    (_, image), view = next(phantom.photos()), phantom.views[0]
    found = detect(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
    true = view.project(phantom.truth.marker_corners[0])
    assert np.linalg.norm(found[5] - true, axis=1).max() < 1.5


@pytest.mark.parametrize(
    "change",
    [{"photos": 0}, {"edge_mm": 0.0}, {"marker_ids": ()}, {"marker_ids": (1, 1)}, {"noise": -1.0},
     {"wavelength_nm": (900.0, 400.0)}, {"specimen_mm": (0.0, 20.0, 10.0)}, {"noise": float("nan")}],
)  # fmt: skip
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


@pytest.mark.parametrize(("name", "photos", "bands"), [("phantom_a", 24, 64), ("phantom_hard", 26, 24)])
def test_the_path_traced_phantoms_load_alike(data_dir: Path, name: str, photos: int, bands: int) -> None:
    truth = load_truth(data_dir / name / "truth.npz")
    assert len(truth.views) == len(truth.photo_names) == photos
    assert truth.views[0].intrinsics.width == truth.views[0].intrinsics.height == 512
    assert truth.materials == MATERIALS
    assert truth.endmembers.shape == (9, bands)
    rows, cols = np.indices(truth.hsi_class.shape)
    pixels = truth.hsi_view.project(truth.hsi_xyz.astype(float))
    hit = truth.hsi_class > 0
    assert np.abs(pixels - np.stack([cols, rows], -1))[hit].max() < 0.02
    image = cv2.imread(str(data_dir / name / truth.photo_names[3]), cv2.IMREAD_GRAYSCALE)
    found = detect(np.asarray(image, np.uint8))
    assert found
    for marker_id, corners in found.items():
        true = truth.views[3].project(truth.marker_corners[marker_id])
        assert np.median(np.linalg.norm(corners - true, axis=1)) < 2

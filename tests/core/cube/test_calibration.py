"""Raw counts turned into reflectance by a white and a dark reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap_core.cube import open_cube
from specimap_core.errors import CubeContentError, SettingsError
from tests.support.cube_files import FILE_AXES, Values, random_values, write_envi
from tests.support.notices import messages


def references(tmp_path: Path, shape: tuple[int, int, int] = (3, 5, 11)) -> tuple[Values, Values, Path, Path]:
    rng = np.random.default_rng(3)
    dark = rng.integers(90, 110, shape).astype("u2")
    white = rng.integers(3000, 4000, shape).astype("u2")
    white_path = write_envi(tmp_path / "white.hdr", white, "bip")
    dark_path = write_envi(tmp_path / "dark.hdr", dark, "bsq")
    return white.mean(0), dark.mean(0), white_path, dark_path


@pytest.mark.parametrize("interleave", FILE_AXES)
def test_calibration(tmp_path: Path, interleave: str) -> None:
    white, dark, white_path, dark_path = references(tmp_path)
    truth = np.random.default_rng(4).random((7, 5, 11))
    raw = np.round(dark + truth * (white - dark)).astype("u2")
    path = write_envi(tmp_path / "raw.hdr", raw, interleave)
    cube = open_cube(path, white=white_path, dark=dark_path)
    expected = (raw - dark) / (white - dark)
    assert cube.dtype == np.float32
    assert (cube.quantity, cube.to_reflectance) == ("reflectance", 1.0)
    got = cube.read_rows(0, 7)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-6)
    assert np.abs(got - truth).max() < 0.5 / 2890 * 1.01  # half a count of the narrowest span
    np.testing.assert_array_equal(cube.band(4), got[..., 4])
    np.testing.assert_allclose(cube.mean_image(), expected.mean(-1), rtol=1e-5)
    assert cube.fingerprint() != open_cube(path).fingerprint()
    without_dark = open_cube(path, white=white_path)
    np.testing.assert_allclose(without_dark.read_rows(0, 7), raw / white, rtol=1e-5)
    assert "dark_missing" in messages(without_dark.warnings)


def test_one_column_references_broadcast(tmp_path: Path) -> None:
    white, dark, white_path, dark_path = references(tmp_path, (3, 1, 11))
    raw = np.random.default_rng(0).integers(100, 3000, (4, 5, 11)).astype("u2")
    cube = open_cube(write_envi(tmp_path / "raw.hdr", raw), white=white_path, dark=dark_path)
    np.testing.assert_allclose(cube.read_rows(0, 4), (raw - dark) / (white - dark), rtol=1e-5, atol=1e-6)


def test_white_not_brighter_than_dark(tmp_path: Path) -> None:
    _, _, white_path, dark_path = references(tmp_path)
    white = np.full((1, 5, 11), 4000, "u2")
    white[0, 2, 3], white[0, 4, 10] = 0, 50
    write_envi(white_path, white)
    raw = write_envi(tmp_path / "raw.hdr", random_values("u2"))
    cube = open_cube(raw, white=white_path, dark=dark_path)
    lost = np.isnan(cube.read_rows(0, 7))
    assert lost[:, 2, 3].all()
    assert lost[:, 4, 10].all()
    assert lost.sum() == 14
    assert np.isfinite(cube.mean_image()).all()
    assert "2 of 55" in messages(cube.warnings)["reference_invalid"]
    bright = write_envi(tmp_path / "bright.hdr", np.full((1, 5, 11), 9000, "u2"))
    with pytest.raises(CubeContentError, match="nowhere brighter"):
        open_cube(raw, white=dark_path, dark=bright)


def test_references_that_do_not_fit(tmp_path: Path) -> None:
    _, _, white_path, dark_path = references(tmp_path)
    for shape in ((7, 6, 11), (7, 5, 10)):
        raw = write_envi(tmp_path / "raw.hdr", random_values("u2", shape))
        with pytest.raises(CubeContentError) as caught:
            open_cube(raw, white=white_path, dark=dark_path)
        assert caught.value.details["reference"] == "white"
    with pytest.raises(SettingsError):
        open_cube(raw, dark=dark_path)


def test_dropped_frames_have_no_reflectance(tmp_path: Path) -> None:
    """Zeros in all bands lie below any dark signal: nothing was recorded, and nothing was dark."""
    white, dark, white_path, dark_path = references(tmp_path)
    truth = np.random.default_rng(4).uniform(0.1, 0.9, (7, 5, 11))
    raw = np.round(dark + truth * (white - dark)).astype("u2")
    raw[[2, 5]] = 0
    raw[3, 1, 4] = 0  # one element alone is a value
    cube = open_cube(write_envi(tmp_path / "raw.hdr", raw, "bil"), white=white_path, dark=dark_path)
    got = cube.read_rows(0, 7)
    assert np.isnan(got[[2, 5]]).all()
    assert np.isfinite(np.delete(got, [2, 5], 0)).all()
    np.testing.assert_array_equal(cube.band(4), got[..., 4])
    assert np.isnan(cube.mean_image()).sum() == 10


@pytest.mark.parametrize(("share", "said"), [(1.0, False), (0.5, False), (0.1, True)])
def test_a_white_of_another_exposure_is_noticed(tmp_path: Path, share: float, said: bool) -> None:
    rng = np.random.default_rng(6)
    white = rng.uniform(3000, 3100, (1, 40, 6))
    raw = write_envi(tmp_path / "raw.hdr", np.rint(rng.uniform(0.1, 0.9, (30, 40, 6)) * white).astype("u2"))
    reference = write_envi(tmp_path / "w.hdr", np.rint(white * share).astype("u2"))
    cube = open_cube(raw, white=reference)
    assert ("reflectance_implausible" in messages(cube.warnings)) == said


@pytest.mark.parametrize(
    ("of_white", "of_raw", "said"),
    [
        ("9.96", "9.96", False),
        ("10.0", "9.96", False),
        ("2.0", "10.0", True),
        ("2 ms", "10 ms", True),
        ("", "10", False),
        ("{1, 2}", "10", False),
        ("0", "10", False),
        ("auto", "10", False),
    ],
)
def test_an_exposure_that_differs_is_said(tmp_path: Path, of_white: str, of_raw: str, said: bool) -> None:
    values = random_values("u2", (4, 5, 11)) // 20 + 100
    raw = write_envi(tmp_path / "raw.hdr", values, tint=of_raw)
    dark = write_envi(tmp_path / "dark.hdr", np.full_like(values, 90), tint=of_raw)
    cube = open_cube(raw, white=write_envi(tmp_path / "w.hdr", values[:1] + 50, tint=of_white), dark=dark)
    described = messages(cube.warnings).get("reference_exposure_differs", "")
    assert bool(described) == said
    assert not said or "white reference was exposed 0.2 times as long" in described

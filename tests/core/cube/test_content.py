"""What a cube says of itself: wavelengths, bad bands, quantity, fingerprint, and warnings of its content."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.cube import inspect, open_cube
from specimap_core.errors import CubeContentError
from specimap_core.screening.cube import judge_cube
from tests.support.cube_files import FILE_AXES, Values, random_values, write_envi

# ---- wavelengths, bad bands, quantity -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "extra", "nm"),
    [
        ("0.4, 0.5, 1.7", {}, [400, 500, 1700]),
        ("0.4, 0.5, 1.7", {"wavelength_units": "Micrometers"}, [400, 500, 1700]),
        ("0.4, 0.5, 1.7", {"wavelength_units": "um"}, [400, 500, 1700]),
        ("400, 500, 1700", {}, [400, 500, 1700]),
        ("400, 500, 1700", {"wavelength_units": "Nanometers"}, [400, 500, 1700]),
        ("400, 500, 1700", {"wavelength_units": "Unknown"}, [400, 500, 1700]),
        ("10000, 5000, 2500", {"wavelength_units": "Wavenumber"}, [1000, 2000, 4000]),
        ("10000, 5000, 2500", {"z_plot_titles": "{Wavenumbers (cm-1), Unknown}"}, [1000, 2000, 4000]),
    ],
)
def test_wavelength_units(tmp_path: Path, words: str, extra: dict[str, Any], nm: list[float]) -> None:
    values = random_values("u2", (2, 2, 3))
    cube = open_cube(write_envi(tmp_path / "x.hdr", values, wavelength=f"{{{words}}}", **extra))
    np.testing.assert_allclose(cube.wavelengths_nm, nm, rtol=1e-12)
    assert cube.warnings == ()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (None, "wavelengths_missing"),
        ("1, 2", "wavelengths_count_mismatch"),
        ("1, 0, 2", "wavelengths_invalid"),
    ],
)
def test_unusable_wavelengths(tmp_path: Path, words: str | None, code: str) -> None:
    extra: dict[str, Any] = {} if words is None else {"wavelength": f"{{{words}}}"}
    cube = open_cube(write_envi(tmp_path / "x.hdr", random_values("u2", (2, 2, 3)), **extra))
    assert np.isnan(cube.wavelengths_nm).all()
    assert cube.wavelengths_nm.shape == (3,)
    assert [w.code for w in cube.warnings] == [code]


def test_bad_bands_are_left_out_of_the_mean(tmp_path: Path) -> None:
    values = random_values("f4", (4, 3, 5))
    values[..., 2] = np.nan
    for interleave in FILE_AXES:
        cube = open_cube(write_envi(tmp_path / "x.hdr", values, interleave, bbl="{1, 1, 0, 1, 0}"))
        assert cube.bad_bands.tolist() == [False, False, True, False, True]
        np.testing.assert_allclose(cube.mean_image(), values[..., [0, 1, 3]].mean(-1), rtol=1e-5)
        np.testing.assert_allclose(cube.mean_image(np.array([1, 2])), values[..., 1], rtol=1e-6)
        np.testing.assert_allclose(cube.mean_image(slice(3, 5)), values[..., 3:].mean(-1), rtol=1e-5)
        np.testing.assert_allclose(cube.mean_image(~cube.bad_bands), cube.mean_image())
    assert not open_cube(write_envi(tmp_path / "y.hdr", values, bbl="{1}")).bad_bands.any()
    assert not open_cube(write_envi(tmp_path / "z.hdr", values, bbl="{0,0,0,0,0}")).bad_bands.any()
    with pytest.raises(ValueError, match="no band"):
        cube.mean_image(slice(0, 0))


@pytest.mark.parametrize("interleave", FILE_AXES)
def test_many_separate_bands(tmp_path: Path, interleave: str) -> None:
    values = random_values("u2", (6, 5, 80))
    cube = open_cube(write_envi(tmp_path / "x.hdr", values, interleave))
    chosen = np.arange(1, 80, 2)
    np.testing.assert_allclose(cube.mean_image(chosen), values[..., chosen].mean(-1), rtol=1e-6)


@pytest.mark.parametrize("interleave", FILE_AXES)
def test_mean_ignores_nan(tmp_path: Path, interleave: str) -> None:
    values = random_values("f4", (9, 8, 6))
    values[np.random.default_rng(1).random(values.shape) < 0.3] = np.nan
    values[2, 3] = np.nan
    values[1] = np.abs(values[1])
    mean = open_cube(write_envi(tmp_path / "x.hdr", values, interleave)).mean_image()
    known = ~np.isnan(values)
    expected = np.where(known, values, 0).sum(-1, dtype=float) / np.where(known.any(-1), known.sum(-1), np.nan)
    np.testing.assert_allclose(mean, expected, rtol=1e-5)
    assert np.isnan(mean[2, 3])


def test_quantity(tmp_path: Path) -> None:
    counts = random_values("u2")
    share = np.random.default_rng(0).random((40, 30, 8)).astype("f4")
    glint = share.copy()
    glint[20, 15, 3] = 40.0
    cases: tuple[tuple[Values, dict[str, Any], float | None], ...] = (
        (counts, {}, None),
        (counts, {"reflectance_scale_factor": 10000}, 1e-4),
        (share, {}, 1.0),
        (glint, {}, 1.0),
        (share * 100, {}, None),
        (share * 0, {}, None),
        (share * np.float32(np.nan), {}, None),
    )
    for values, extra, factor in cases:
        cube = open_cube(write_envi(tmp_path / "x.hdr", values, **extra))
        assert cube.to_reflectance == (pytest.approx(factor) if factor else None)
        assert cube.quantity == ("reflectance" if factor else "counts")


def test_fingerprint_depends_on_content_alone(tmp_path: Path) -> None:
    values = random_values("u2")
    one = open_cube(write_envi(tmp_path / "one.hdr", values)).fingerprint()
    path = write_envi(tmp_path / "two.hdr", values)
    assert open_cube(path).fingerprint() == one
    assert len(one) == 64
    raw = bytearray(path.with_suffix(".raw").read_bytes())
    raw[-1] ^= 1
    path.with_suffix(".raw").write_bytes(raw)
    assert open_cube(path).fingerprint() != one
    path = write_envi(tmp_path / "three.hdr", values, description="x")
    assert open_cube(path).fingerprint() != one


def test_rows_out_of_range(tmp_path: Path) -> None:
    cube = open_cube(write_envi(tmp_path / "x.hdr", random_values("u2")))
    for start, stop in ((-1, 2), (0, 8), (3, 3)):
        with pytest.raises(IndexError):
            cube.read_rows(start, stop)
    with pytest.raises(IndexError):
        cube.band(11)


# ---- content --------------------------------------------------------------------------------------------


def codes(tmp_path: Path, values: Values, **extra: Any) -> set[str]:
    cube = open_cube(write_envi(tmp_path / "x.hdr", values, **extra))
    return {w.code for w in inspect(cube, cube.mean_image())}


def scene(dtype: str = "u2") -> Values:
    rng = np.random.default_rng(8)
    return (rng.gamma(4, 200, (40, 30, 1)) * rng.uniform(0.5, 1, (40, 30, 12)) + 50).astype(dtype)


def test_a_plain_scene_has_nothing_to_warn_of(tmp_path: Path) -> None:
    for dtype in ("u2", "f4", "i4"):
        assert codes(tmp_path, scene(dtype)) == set()


def test_content_warnings(tmp_path: Path) -> None:
    assert codes(tmp_path, scene()[..., :1]) == {"single_band"}
    dead = scene()
    dead[..., 4] = 0
    assert codes(tmp_path, dead) == {"bands_all_zero"}
    assert codes(tmp_path, dead, bbl="{1,1,1,1,0,1,1,1,1,1,1,1}") == set()
    holes = scene("f4")
    holes[5:15, 5:15] = np.nan
    assert codes(tmp_path, holes) == {"pixels_nan"}
    holes = scene("f4")
    holes[5:15, 5:15, 3] = np.nan
    assert codes(tmp_path, holes) == {"values_nan"}
    assert codes(tmp_path, np.minimum(scene(), 1200).astype("u2")) == {"saturated"}
    assert codes(tmp_path, np.minimum(scene("f4"), np.float32(1200))) == {"saturated"}
    assert codes(tmp_path, np.minimum(scene() * 40.0, 65535).astype("u2")) == {"saturated"}


@pytest.mark.parametrize("value", [0.0, 0.3, np.nan])
def test_nothing_usable(tmp_path: Path, value: float) -> None:
    with pytest.raises(CubeContentError):
        codes(tmp_path, np.full((6, 5, 4), value, "f4"))


def test_a_refusal_speaks_of_the_file_as_what_it_is(tmp_path: Path) -> None:
    np.save(tmp_path / "flat.npy", np.full((4, 5, 6), 7, np.uint16))
    assert judge_cube(tmp_path / "flat.npy").reason == "All values of the cube are the same."
    np.save(tmp_path / "complex.npy", np.zeros((4, 5, 6), np.complex64))
    assert judge_cube(tmp_path / "complex.npy").reason.startswith("The cube holds values of type complex64")

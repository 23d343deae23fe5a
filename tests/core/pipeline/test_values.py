"""Runs on cubes with borders of no-data, dead columns, other scales: the same places, and flags that are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.arrays import Array
from specimap_core.cloud import Cloud, Flag
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from tests.support.cube_files import Values, write_envi
from tests.support.scenes import Finished, OnDisk, xyz_image
from tests.support.value_files import listed

BORDER = 25


def framed(values: Values, value: float) -> Values:
    return np.pad(values, ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), constant_values=value)


def cubes(values: Values) -> dict[str, tuple[Values, dict[str, Any]]]:
    bands = values.shape[2]
    share = (values / 10000).astype(np.float32)
    dead = share.copy()
    dead[:, 31] = dead[:, 90:92] = 1e6
    single = share.copy()
    single[40, 50] = single[70, 20, 3] = 1e6
    gains, offsets = np.linspace(0.5e-4, 1.5e-4, bands), np.linspace(-0.05, 0.0, bands)
    scale = {"reflectance_scale_factor": 10000}
    return {
        "i2": (framed(values.astype(np.int16), -9999), scale | {"data_ignore_value": -9999}),
        "u2": (framed(values, 65535), scale | {"data_ignore_value": 65535}),
        "f4": (framed(share, -9999), {"data_ignore_value": "-9.999e3"}),
        "nan": (framed(share, np.nan), {}),
        "dead": (dead, {}),
        "single": (single, {}),
        "gains": (
            np.rint((share - offsets) / gains).clip(0, 65535).astype(np.uint16),
            {"data_gain_values": listed(gains), "data_offset_values": listed(offsets)},
        ),
        "factor": (share, scale),
        "negative": ((values.astype(np.int32) - 500).astype(np.int16), scale),
    }


def spectra_image(cloud: Cloud, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Spectra and flags by pixel; NaN and 0 where there is no point."""
    spectra, flags = np.full((*shape, cloud.bands), np.nan, np.float32), np.zeros(shape, np.uint8)
    at = tuple(cloud.hsi_pixel.astype(int).T)
    spectra[at], flags[at] = cloud.spectra(slice(None)), cloud.flags
    return spectra, flags


@pytest.mark.slow
@pytest.mark.parametrize("name", ["i2", "u2", "f4", "nan", "dead", "single", "gains", "factor", "negative"])
def test_the_same_result_however_values_are_stored(
    small: OnDisk, finished: Finished, tmp_path: Path, name: str
) -> None:
    plain = small.values()
    values, output = cubes(plain)[name]
    edge = BORDER if len(values) > len(plain) else 0
    wavelengths = listed(small.truth.wavelengths_nm)
    path = write_envi(tmp_path / "x.hdr", values, "bil", wavelength=wavelengths, wavelength_units="nm", **output)
    out = finished.copy_to(tmp_path / "out")
    report: Report = run_pipeline(Inputs(small.photos, path), out, PipelineSettings())
    assert report.marker_ids_in_cube == finished.report.marker_ids_in_cube
    assert report.corner_2d_mm.mean < 1.1 * finished.report.corner_2d_mm.mean + 0.002
    shape = (values.shape[0], values.shape[1])
    inner = (slice(edge, shape[0] - edge), slice(edge, shape[1] - edge))
    apart = np.linalg.norm(xyz_image(out, shape)[inner] - xyz_image(finished.out, plain.shape[:2]), axis=-1)
    assert np.isfinite(apart).mean() > 0.9 * np.isfinite(xyz_image(finished.out, plain.shape[:2])[..., 0]).mean()
    assert np.nanmedian(apart) < 0.01
    cloud = Cloud.open(out / "cloud.zarr")
    assert cloud.quantity == "reflectance"
    spectra, flags = spectra_image(cloud, shape)
    right = plain / 10000 - (0.05 if name == "negative" else 0)
    if name == "gains":
        gains, offsets = (np.array([float(n) for n in output[key].strip("{}").split(",")]) for key in sorted(output))
        right = values * gains + offsets
    missing = np.zeros(plain.shape, bool)
    if name == "dead":
        missing[:, [31, 90, 91]] = True
    if name == "single":
        missing[40, 50] = missing[70, 20, 3] = True
    placed = np.isfinite(apart)
    want = np.where(missing, np.nan, right)[placed]
    np.testing.assert_allclose(spectra[inner][placed], want, rtol=0, atol=0.51e-4 if name == "gains" else 1e-6)
    lacks: Array = np.greater(flags & np.uint8(Flag.NO_DATA), 0)
    assert (lacks[inner][placed] == np.asarray(missing.any(-1))[placed]).all()
    assert (flags & Flag.SATURATED == 0).all()
    outside = np.ones(shape, bool)
    outside[inner] = False
    beyond = outside & np.isfinite(xyz_image(out, shape)[..., 0])
    assert lacks[beyond].all()
    assert np.isnan(spectra[beyond]).all()
    # What is flagged is counted.
    said_of = {w.code: w.message for w in report.warnings}
    lacking = int((cloud.flags & Flag.NO_DATA > 0).sum())
    assert ("points_no_data" in said_of) == (lacking > 0)
    assert lacking == 0 or said_of["points_no_data"].startswith(f"{lacking} of {cloud.n_points} ")
    assert "specimen_moved" not in said_of
    attributes = {w["code"] for w in cloud.report["warnings"]}  # type: ignore[attr-defined]
    assert attributes == set(said_of)

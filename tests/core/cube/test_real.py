"""Real cubes against known answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from specimap_core.cube import inspect, open_cube
from specimap_core.errors import CubeHeaderError
from tests.support.cube_files import FILE_AXES, check_reads
from tests.support.notices import messages

tifffile = pytest.importorskip("tifffile")

TWINS = ["byte", "int16", "int32", "uint16", "uint32", "float32", "float64", "utmsmall"]
REFUSED = {
    "gdal_autotest/cfloat32.hdr": "data type",
    "gdal_autotest/cfloat64.hdr": "data type",
    "gdal_autotest/testenviclasses.hdr": "file type",
    "plantcv_headwall/arcgis.hdr": "ENVI",
    "plantcv_headwall/darkReference_arcgis.hdr": "ENVI",
    "plantcv_headwall/darkReference4.hdr": "interleave",
}
SHAPES = {
    "envijl/test.bil.hdr": (10, 10, 10),
    "envijl/test.bip.hdr": (10, 10, 10),
    "envijl/test.bsq.hdr": (10, 10, 10),
    "gdal_autotest/aea.hdr": (3, 434, 1),
    "gdal_autotest/aea_compressed.hdr": (3, 434, 1),
    "gdal_autotest/envi_rgbsmall_bil.hdr": (49, 50, 3),
    "gdal_autotest/envi_rgbsmall_bip.hdr": (49, 50, 3),
    "gdal_autotest/envi_rgbsmall_bsq.hdr": (49, 50, 3),
    "gdal_autotest/envirpc.hdr": (1, 1, 1),
    "gdal_autotest/envistat.hdr": (2, 2, 6),
    "gdal_autotest/rotation.hdr": (1, 1, 1),
    "gdal_autotest/uint16_envi_bigendian.hdr": (20, 20, 1),
    "gdal_autotest/utmsmall.hdr": (100, 100, 1),
    "hylite_specim_fenix/Radiometric_2x2_1x1.hdr": (1, 384, 624),
    "hylite_specim_fenix/Radiometric_4x2_1x1.hdr": (1, 384, 450),
    "hylite_specim_fenix/Radiometric_8x2_1x1.hdr": (1, 384, 363),
    "hyspec_read_envi/example2.hdr": (30, 14, 1738),
    "hyspec_read_envi/toy.hdr": (167, 150, 4),
    "plantcv_headwall/corn-kernel-hyperspectral.hdr": (31, 43, 580),
    "plantcv_headwall/darkReference.hdr": (1, 1600, 978),
    "plantcv_headwall/darkReference2.hdr": (1, 1600, 978),
    "plantcv_headwall/darkReference3.hdr": (1, 1600, 978),
} | {f"gdal_autotest/{name}.hdr": (20, 20, 1) for name in TWINS[:-1]}


def test_every_real_header_is_read_or_refused_for_its_reason(data_dir: Path) -> None:
    folder = data_dir / "real_envi"
    headers = {p.relative_to(folder).as_posix() for p in folder.rglob("*.hdr")}
    assert headers == SHAPES.keys() | REFUSED.keys()
    for name, field in REFUSED.items():
        with pytest.raises(CubeHeaderError) as caught:
            open_cube(folder / name)
        assert caught.value.details["field"] == field, name
    for name, shape in SHAPES.items():
        cube = open_cube(folder / name)
        assert (cube.rows, cube.cols, cube.bands) == shape, name
        rows = cube.read_rows(0, cube.rows)
        np.testing.assert_allclose(
            cube.mean_image(), rows.astype(np.float64).mean(-1), rtol=1e-5, atol=1e-6, err_msg=name
        )


@pytest.mark.parametrize("name", TWINS)
def test_real_file_equals_its_tiff_twin(data_dir: Path, name: str) -> None:
    folder = data_dir / "real_envi" / "gdal_autotest"
    twin = open_cube(folder / f"{name}.tif")
    truth = tifffile.imread(folder / f"{name}.tif")[..., None]
    for path in (folder / f"{name}.hdr", folder / f"{name}.raw", twin.path):
        check_reads(open_cube(path), truth)


def test_real_interleaves_agree(data_dir: Path) -> None:
    gdal, envijl = data_dir / "real_envi/gdal_autotest", data_dir / "real_envi/envijl"
    truth = np.fromfile(gdal / "envi_rgbsmall_bip.img", "u1").reshape(49, 50, 3)
    for interleave in FILE_AXES:
        check_reads(open_cube(gdal / f"envi_rgbsmall_{interleave}.hdr"), truth)
    truth = np.fromfile(envijl / "test.bip", "f8").reshape(10, 10, 10)
    for interleave in FILE_AXES:
        check_reads(open_cube(envijl / f"test.{interleave}.hdr"), truth)
        check_reads(open_cube(envijl / f"test.{interleave}"), truth)


def test_real_byte_order_and_compression(data_dir: Path) -> None:
    folder = data_dir / "real_envi/gdal_autotest"
    big = open_cube(folder / "uint16_envi_bigendian.hdr").read_rows(0, 20)
    np.testing.assert_array_equal(big, open_cube(folder / "uint16.hdr").read_rows(0, 20))
    packed = open_cube(folder / "aea_compressed.hdr").read_rows(0, 3)
    np.testing.assert_array_equal(packed, open_cube(folder / "aea.hdr").read_rows(0, 3))


def test_real_wavelengths(data_dir: Path) -> None:
    folder = data_dir / "real_envi"
    wrong = open_cube(folder / "plantcv_headwall/darkReference2.hdr")
    assert np.isnan(wrong.wavelengths_nm).all()
    assert [w.code for w in wrong.warnings] == ["wavelengths_count_mismatch"]
    right = open_cube(folder / "plantcv_headwall/darkReference.hdr")
    assert right.wavelengths_nm[[0, 1]].tolist() == [379.027, 379.663]
    assert right.quantity == "counts"
    corn = open_cube(folder / "plantcv_headwall/corn-kernel-hyperspectral.hdr")
    assert corn.wavelengths_nm[[0, -1]].tolist() == [366.551, 1048.421]
    assert [w.code for w in corn.warnings] == ["byte_order_assumed"]
    assert corn.read_rows(0, 31).max() < 2**14  # the other byte order would reach 65535
    infrared = open_cube(folder / "hyspec_read_envi/example2.hdr")
    np.testing.assert_allclose(infrared.wavelengths_nm[[0, -1]], [1e7 / 649.90, 1e7 / 3999.70])
    assert np.isnan(open_cube(folder / "hyspec_read_envi/toy.hdr").wavelengths_nm).all()


def test_real_fx10_triple(data_dir: Path) -> None:
    folder = data_dir / "real_hsi_specim_fx10"
    capture, white, dark = (folder / f"{name}.nc" for name in ("capture", "white", "black"))
    raw = open_cube(capture)
    assert (raw.rows, raw.cols, raw.bands, raw.dtype) == (2, 1024, 448, np.dtype("i2"))
    assert raw.quantity == "counts"
    assert raw.wavelengths_nm[[0, -1]].tolist() == [397.01, 1004.52]
    assert raw.read_rows(0, 1)[0, 0, :4].tolist() == [464, 489, 520, 548]
    itself = open_cube(white, white=white, dark=dark).read_rows(0, 2)
    np.testing.assert_allclose(itself.mean(0), 1, atol=1e-4)  # its rows' mean is the reference
    assert abs(itself - 1).max() < 0.5
    assert abs(itself - 1).mean() < 0.02
    nothing = open_cube(dark, white=white, dark=dark).read_rows(0, 2)
    assert abs(np.median(nothing)) < 1e-3
    sample = open_cube(capture, white=white, dark=dark)
    values = sample.read_rows(0, 2)
    assert "reference_invalid" not in messages(sample.warnings)
    assert 0.2 < np.median(values) < 0.9
    assert ((values > 0) & (values < 1.3)).mean() > 0.999


def test_phantoms(data_dir: Path) -> None:
    for name, bands in (("phantom_a", 64), ("phantom_hard", 24)):
        cube = open_cube(data_dir / name / "hsi" / "hsi.hdr")
        assert (cube.rows, cube.cols, cube.bands) == (512, 640, bands)
        assert cube.to_reflectance == pytest.approx(1e-4)
        assert cube.wavelengths_nm[0] == 400
        mean = cube.mean_image()
        assert 0 < np.median(mean) < 10000
        inspect(cube, mean)

"""TIFF cubes: every compression that is read gives its values; every other one is named."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import tifffile

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, SpecimapError
from tests.support.cube_files import Values, check_reads, random_values
from tests.support.notices import messages

LOSSLESS = ["lzw", "zlib", "adobe_deflate", "packbits", "lzma", "zstd"]


def smooth(dtype: str) -> Values:
    """Values with structure, so that compressions have something to shorten."""
    rows, cols, bands = np.meshgrid(np.arange(40), np.arange(33), np.arange(11), indexing="ij")
    return (100 + 3 * rows + 2 * cols + bands + rows * cols % 7).astype(dtype)


@pytest.mark.slow
@pytest.mark.parametrize("compression", LOSSLESS)
@pytest.mark.parametrize("predictor", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4", "f8"])
@pytest.mark.parametrize("order", "<>")
def test_compressions(tmp_path: Path, compression: str, predictor: bool, dtype: str, order: Literal["<", ">"]) -> None:
    predictor = predictor and compression != "packbits"
    values = smooth(dtype)
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    for layout, stored in (("pages", pages), ("contig", values), ("tiles", pages), ("separate", pages)):
        options: dict[str, Any] = {"tile": (16, 32)} if layout == "tiles" else {"rowsperstrip": 13}
        if layout in ("contig", "separate"):
            options["planarconfig"] = layout
        path = tmp_path / f"{layout}.tif"
        tifffile.imwrite(
            path,
            stored,
            photometric="minisblack",
            compression=compression,
            predictor=predictor,
            byteorder=order,
            metadata=None,
            **options,
        )
        with tifffile.TiffFile(path) as file:
            page = file.pages.first
            assert (page.compression > 1, page.predictor > 1) == (True, predictor)
        cube = open_cube(path)
        check_reads(cube, values)
        assert [w.code for w in cube.warnings] == ["wavelengths_missing"]


@pytest.mark.parametrize("dtype", ["u1", "u2", "f2", "f4", "f8", "u4"])
@pytest.mark.parametrize("order", "<>")
def test_big_tiff(tmp_path: Path, dtype: str, order: Literal["<", ">"]) -> None:
    values = smooth(dtype)
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(tmp_path / "x.btf", pages, photometric="minisblack", bigtiff=True, byteorder=order)
    if dtype == "f2":  # its sums overflow in the reference
        np.testing.assert_array_equal(open_cube(tmp_path / "x.btf").read_rows(0, 40), values)
    else:
        check_reads(open_cube(tmp_path / "x.btf"), values)


def test_jpeg_is_read_and_said(tmp_path: Path) -> None:
    values = smooth("u1")
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    tifffile.imwrite(
        tmp_path / "x.tif", pages, photometric="minisblack", compression="jpeg", compressionargs={"level": 98}
    )
    cube = open_cube(tmp_path / "x.tif")
    assert "JPEG" in messages(cube.warnings)["values_lossy"]
    apart = cube.read_rows(0, 40).astype(int) - values
    assert 0 < np.abs(apart).max() < 12


@pytest.mark.parametrize(
    ("code", "name"),
    [(34712, "JPEG2000"), (50001, "WEBP"), (34887, "LERC"), (50002, "JPEGXL"), (12345, "12345"), (2, "CCITTRLE")],
)
def test_a_compression_that_is_not_read_is_named(tmp_path: Path, code: int, name: str) -> None:
    path = tmp_path / "x.tif"
    pages = np.ascontiguousarray(smooth("u1").transpose(2, 0, 1))
    tifffile.imwrite(path, pages, photometric="minisblack", compression="packbits", metadata=None)
    entry = struct.pack("<HHI", 259, 3, 1) + struct.pack("<H", 32773)
    raw = path.read_bytes()
    assert raw.count(entry) == 11
    path.write_bytes(raw.replace(entry, entry[:-2] + struct.pack("<H", code)))
    with pytest.raises(CubeFormatError, match=name) as caught:
        open_cube(path)
    assert "damaged" not in str(caught.value)
    assert "COMPRESS=DEFLATE" in caught.value.advice


def test_bands_written_one_by_one(tmp_path: Path) -> None:
    values = random_values("u2")
    with tifffile.TiffWriter(tmp_path / "x.tif") as writer:
        for band in values.transpose(2, 0, 1):
            writer.write(band, photometric="minisblack", description="one band")
    check_reads(open_cube(tmp_path / "x.tif"), values)
    with tifffile.TiffWriter(tmp_path / "y.tif") as writer:
        for band in values.transpose(2, 0, 1):
            writer.write(band)
    check_reads(open_cube(tmp_path / "y.tif"), values)


def test_several_images_are_said(tmp_path: Path) -> None:
    values = random_values("u2", (9, 8, 6))
    with tifffile.TiffWriter(tmp_path / "x.tif") as writer:
        writer.write(random_values("u2").transpose(2, 0, 1), photometric="minisblack")
        writer.write(values.transpose(2, 0, 1), photometric="minisblack")
        writer.write(values[..., 0], photometric="minisblack")
    cube = open_cube(tmp_path / "x.tif")
    check_reads(cube, values)
    assert "6x9x8" in messages(cube.warnings)["dataset_chosen"]


def test_refusals_name_the_axes(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "x.tif", np.zeros((2, 3, 8, 9), "u1"), photometric="minisblack")
    with pytest.raises(CubeFormatError, match=r"Y 8, X 9"):
        open_cube(tmp_path / "x.tif")
    tifffile.imwrite(tmp_path / "flat.tif", np.zeros((8, 9), "u1"), photometric="minisblack")
    assert open_cube(tmp_path / "flat.tif").bands == 1


@pytest.mark.parametrize("compression", [*LOSSLESS, "jpeg"])
def test_damaged_compressed_files(tmp_path: Path, compression: str) -> None:
    pages = np.ascontiguousarray(smooth("u1").transpose(2, 0, 1))
    path = tmp_path / "x.tif"
    tifffile.imwrite(path, pages, photometric="minisblack", compression=compression, predictor=False)
    whole = path.read_bytes()
    rng = np.random.default_rng(11)
    refused = 0
    for trial in range(60):
        damaged = bytearray(whole[: rng.integers(1, len(whole))] if trial % 3 == 0 else whole)
        for at in rng.integers(0, len(damaged), 6):
            damaged[at] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            cube = open_cube(path)
            cube.read_rows(0, cube.rows)
        except SpecimapError:
            refused += 1
    assert refused >= 15

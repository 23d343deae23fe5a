"""ENVI cubes: every type, interleave, byte order and name is read, a wrong header is refused by its field."""

from __future__ import annotations

import gzip
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specimap_core.cube import open_cube
from specimap_core.errors import CubeFormatError, CubeHeaderError, CubeNotFoundError, CubeTruncatedError
from tests.support.cube_files import DTYPES, FILE_AXES, check_reads, random_values, write_envi
from tests.support.notices import messages


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("interleave", FILE_AXES)
@pytest.mark.parametrize("order", "<>")
def test_envi_every_type_interleave_and_byte_order(
    tmp_path: Path, dtype: str, interleave: str, order: Literal["<", ">"]
) -> None:
    values = random_values(dtype)
    for offset in (0, 3):
        path = write_envi(tmp_path / f"c{offset}.hdr", values, interleave, order=order, offset=offset)
        check_reads(open_cube(path), values)


@settings(max_examples=60, deadline=None)
@given(
    shape=st.tuples(*[st.integers(1, 9)] * 3),
    dtype=st.sampled_from(DTYPES),
    interleave=st.sampled_from(sorted(FILE_AXES)),
    order=st.sampled_from("<>"),
    offset=st.integers(0, 40),
    compress=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_envi_round_trip(
    shape: tuple[int, int, int],
    dtype: str,
    interleave: str,
    order: Literal["<", ">"],
    offset: int,
    compress: bool,
    seed: int,
) -> None:
    values = random_values(dtype, shape, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.hdr"
        write_envi(path, values, interleave, order=order, offset=offset, compress=compress)
        check_reads(open_cube(path), values)


@pytest.mark.parametrize("interleave", FILE_AXES)
def test_wide_cube_is_turned_in_several_blocks(tmp_path: Path, interleave: str) -> None:
    values = random_values("u2", (19, 4001, 3))
    check_reads(open_cube(write_envi(tmp_path / "w.hdr", values, interleave)), values)


def test_envi_defaults_and_comments(tmp_path: Path) -> None:
    values = random_values("u2")
    dropped = ("byte order", "header offset", "file type")
    path = write_envi(tmp_path / "x.hdr", values, "bil", drop=dropped)
    text = path.read_text().replace("ENVI\n", "ENVI\n; bands = 99\n")
    path.write_text(text + "wavelength = {\n1.5,2.5,3.5,\n; 400 = not a wavelength }\n4,5,6,7,8,9,10,11 }\n")
    cube = open_cube(path)
    check_reads(cube, values)
    assert messages(cube.warnings).keys() == {"byte_order_assumed"}
    np.testing.assert_allclose(cube.wavelengths_nm, np.array([1.5, 2.5, 3.5, *range(4, 12)]) * 1e3)


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("x.hdr", "x"),
        ("x.hdr", "x.raw"),
        ("x.hdr", "x.img"),
        ("x.hdr", "x.dat"),
        ("x.hdr", "x.bsq"),
        ("x.bsq.hdr", "x.bsq"),
        ("X.HDR", "x.RAW"),
        ("x.hdr", "X.IMG"),
        ("a.b.hdr", "a.b.raw"),
    ],
)
def test_envi_names(tmp_path: Path, header: str, data: str) -> None:
    values = random_values("u2")
    made = write_envi(tmp_path / "made.hdr", values)
    made.with_suffix(".raw").rename(tmp_path / data)
    made.rename(tmp_path / header)
    check_reads(open_cube(tmp_path / header), values)
    by_data = open_cube(tmp_path / data)
    check_reads(by_data, values)
    assert by_data.fingerprint() == open_cube(tmp_path / header).fingerprint()


def test_envi_prefers_data_that_are_long_enough(tmp_path: Path) -> None:
    values = random_values("u2")
    path = write_envi(tmp_path / "x.hdr", values)
    (tmp_path / "x.img").write_bytes(b"thumbnail")
    (tmp_path / "x").mkdir()
    check_reads(open_cube(path), values)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("samples", 0),
        ("lines", -4),
        ("bands", "many"),
        ("samples", "9" * 400),
        ("lines", 10**12),
        ("bands", ""),
        ("lines", "7.5"),
        ("bands", 2**31 - 1),
        ("data type", 6),
        ("data type", 9),
        ("data type", 7),
        ("data type", "float"),
        ("interleave", "bup"),
        ("interleave", ""),
        ("byte order", 2),
        ("header offset", -1),
        ("file compression", 3),
        ("file type", "ENVI Classification"),
        ("file type", "ENVI Spectral Library"),
        ("wavelength", "{400, red}"),
        ("bbl", "{1, x}"),
        ("reflectance scale factor", 0),
        ("reflectance scale factor", "nan"),
    ],
)
def test_envi_refusals_name_the_field(tmp_path: Path, field: str, value: object) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"), drop=(field,))
    path.write_text(f"{path.read_text()}{field} = {value}\n")
    if field == "bands" and value == 2**31 - 1:  # alone it would only be truncated
        path.write_text(path.read_text().replace("lines = 7", "lines = 2000000000"))
    with pytest.raises(CubeHeaderError) as caught:
        open_cube(path)
    assert caught.value.details["field"] == field
    assert caught.value.advice


@pytest.mark.parametrize("field", ["samples", "lines", "bands", "data type", "interleave"])
def test_envi_missing_fields(tmp_path: Path, field: str) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"), drop=(field,))
    with pytest.raises(CubeHeaderError) as caught:
        open_cube(path)
    assert caught.value.details["field"] == field


def test_envi_contradiction_and_open_list(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"))
    text = path.read_text()
    for added, field in (("Samples = 6\n", "samples"), ("wavelength = {1, 2,\n3,", "wavelength")):
        path.write_text(text + added)
        with pytest.raises(CubeHeaderError) as caught:
            open_cube(path)
        assert caught.value.details["field"] == field


@pytest.mark.parametrize("compress", [False, True])
def test_envi_truncated(tmp_path: Path, compress: bool) -> None:
    values = random_values("u2")
    path = write_envi(tmp_path / "x.hdr", values, compress=compress, offset=4)
    whole = values.nbytes + 4
    if compress:
        path.with_suffix(".raw").write_bytes(gzip.compress(bytes(whole - 9)))
    else:
        path.with_suffix(".raw").write_bytes(bytes(whole - 9))
    with pytest.raises(CubeTruncatedError) as caught:
        open_cube(path)
    assert caught.value.details == {"expected_bytes": whole, "found_bytes": whole - 9}


def test_envi_gzip_cut_or_not_gzip(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"), compress=True)
    data = path.with_suffix(".raw")
    packed = data.read_bytes()
    data.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(CubeTruncatedError):
        open_cube(path)
    data.write_bytes(b"x" * len(packed))
    with pytest.raises(CubeHeaderError) as caught:
        open_cube(path)
    assert caught.value.details["field"] == "file compression"


def test_envi_longer_data_warn(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"))
    with open(path.with_suffix(".raw"), "ab") as f:
        f.write(b"abc")
    assert "data_longer_than_header" in messages(open_cube(path).warnings)


def test_nothing_there(tmp_path: Path) -> None:
    path = write_envi(tmp_path / "x.hdr", random_values("u2"))
    path.with_suffix(".raw").unlink()
    with pytest.raises(CubeNotFoundError):
        open_cube(path)
    with pytest.raises(FileNotFoundError):
        open_cube(tmp_path / "none.hdr")
    with pytest.raises(CubeFormatError):
        open_cube(tmp_path)
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(CubeFormatError):
        open_cube(tmp_path / "notes.txt")

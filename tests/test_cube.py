"""Cubes: generated files of every format against their truth, real files against known answers."""

from __future__ import annotations

import gzip
import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from specimap.core.cube import Cube, inspect, open_cube
from specimap.core.errors import (
    CubeContentError,
    CubeFormatError,
    CubeHeaderError,
    CubeNotFoundError,
    CubeTruncatedError,
    SettingsError,
    SpecimapError,
)

h5py = pytest.importorskip("h5py")
tifffile = pytest.importorskip("tifffile")
scipy_io = pytest.importorskip("scipy.io")

Values = NDArray[Any]
ENVI_CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12, "u4": 13, "i8": 14, "u8": 15}
FILE_AXES = {"bip": (0, 1, 2), "bil": (0, 2, 1), "bsq": (2, 0, 1)}
DTYPES = sorted(ENVI_CODES)


def random_values(dtype: str, shape: tuple[int, int, int] = (7, 5, 11), seed: int = 0) -> Values:
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return (rng.normal(size=shape) * 1000).astype(dtype)
    info = np.iinfo(dtype)
    return rng.integers(info.min, info.max, shape, dtype=dtype, endpoint=True)


def write_envi(
    path: Path,
    values: Values,
    interleave: str = "bsq",
    *,
    order: Literal["<", ">"] = "<",
    offset: int = 0,
    compress: bool = False,
    drop: tuple[str, ...] = (),
    **extra: Any,
) -> Path:
    """Header ``path`` (.hdr) and its data; ``extra`` fields are added, with ``_`` for a space."""
    rows, cols, bands = values.shape
    dtype = values.dtype.newbyteorder(order)
    fields: dict[str, object] = {
        "samples": cols, "lines": rows, "bands": bands, "header offset": offset,
        "file type": "ENVI Standard", "data type": ENVI_CODES[values.dtype.str[1:]],
        "interleave": interleave, "byte order": int(order == ">"),
    }  # fmt: skip
    if compress:
        fields["file compression"] = 1
    fields |= {key.replace("_", " "): value for key, value in extra.items()}
    lines = [f"{key} = {value}" for key, value in fields.items() if key not in drop]
    path.write_text("\n".join(["ENVI", *lines]) + "\n")
    data = b"\xaa" * offset + values.transpose(FILE_AXES[interleave]).astype(dtype).tobytes()
    path.with_suffix(".raw").write_bytes(gzip.compress(data) if compress else data)
    return path


def check_reads(cube: Cube, values: Values) -> None:
    """Every way of reading gives ``values``, contiguous and native."""
    assert (cube.rows, cube.cols, cube.bands) == values.shape
    assert cube.dtype == values.dtype
    assert cube.dtype.isnative
    for start, stop in ((0, cube.rows), (cube.rows // 2, cube.rows // 2 + 1)):
        got = cube.read_rows(start, stop)
        assert got.dtype == values.dtype
        assert got.flags.c_contiguous
        assert got.flags.aligned
        np.testing.assert_array_equal(got, values[start:stop])
    last = cube.band(cube.bands - 1)
    assert last.dtype == values.dtype
    np.testing.assert_array_equal(last, values[..., -1])
    mean = cube.mean_image()
    assert mean.dtype == np.float32
    wide = values.astype(np.float64)
    # Sums of values of both signs cancel: the bound is float32 rounding of the largest term.
    np.testing.assert_allclose(mean, wide.mean(-1), rtol=1e-6, atol=2e-7 * float(np.abs(wide).max()))


# ---- ENVI, generated ------------------------------------------------------------------------------------


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
    path.write_text(text + "wavelength = {\n1,2,3,\n; 400 = not a wavelength }\n4,5,6,7,8,9,10,11 }\n")
    cube = open_cube(path)
    check_reads(cube, values)
    assert dict(cube.warnings).keys() == {"byte_order_assumed"}
    np.testing.assert_allclose(cube.wavelengths_nm, np.arange(1, 12) * 1e3)


@pytest.mark.parametrize(
    ("header", "data"),
    [
        ("x.hdr", "x"), ("x.hdr", "x.raw"), ("x.hdr", "x.img"), ("x.hdr", "x.dat"), ("x.hdr", "x.bsq"),
        ("x.bsq.hdr", "x.bsq"), ("X.HDR", "x.RAW"), ("x.hdr", "X.IMG"), ("a.b.hdr", "a.b.raw"),
    ],
)  # fmt: skip
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
        ("samples", 0), ("lines", -4), ("bands", "many"), ("samples", "9" * 400), ("lines", 10**12),
        ("bands", ""), ("lines", "7.5"), ("bands", 2**31 - 1), ("data type", 6), ("data type", 9),
        ("data type", 7),
        ("data type", "float"), ("interleave", "bup"), ("interleave", ""), ("byte order", 2),
        ("header offset", -1), ("file compression", 3), ("file type", "ENVI Classification"),
        ("file type", "ENVI Spectral Library"), ("wavelength", "{400, red}"), ("bbl", "{1, x}"),
        ("reflectance scale factor", 0), ("reflectance scale factor", "nan"),
    ],
)  # fmt: skip
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
    assert "data_longer_than_header" in dict(open_cube(path).warnings)


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
    assert [c for c, _ in cube.warnings] == [code]


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


# ---- other formats --------------------------------------------------------------------------------------

NM = np.linspace(400, 1000, 11)


@pytest.mark.parametrize("dtype", [*DTYPES, ">u2", ">f4", "f2", "i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path: Path, dtype: str, order: str) -> None:
    values = random_values(np.dtype(dtype).newbyteorder("=").str)
    np.save(tmp_path / "x.npy", np.array(values, dtype, order=order))  # type: ignore[call-overload]
    if dtype == "f2":  # its sums overflow in the reference below
        np.testing.assert_array_equal(open_cube(tmp_path / "x.npy").read_rows(0, 7), values)
    else:
        check_reads(open_cube(tmp_path / "x.npy"), values)


def test_npy_refusals(tmp_path: Path) -> None:
    path = tmp_path / "x.npy"
    np.save(path, np.array([[[{}]]], object), allow_pickle=True)
    with pytest.raises(CubeHeaderError, match="object"):
        open_cube(path)
    np.save(path, np.zeros((2, 2, 2), complex))
    with pytest.raises(CubeHeaderError) as header:
        open_cube(path)
    assert header.value.details["field"] == "dtype"
    np.save(path, np.zeros((2, 2)))
    with pytest.raises(CubeFormatError):
        open_cube(path)
    np.save(path, np.zeros((4, 4, 4)))
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(CubeTruncatedError) as cut:
        open_cube(path)
    assert cut.value.details == {"expected_bytes": whole, "found_bytes": whole - 10}
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(CubeFormatError):
        open_cube(path)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npz(tmp_path: Path, packed: bool, order: str) -> None:
    values = random_values("u2")
    save = np.savez_compressed if packed else np.savez
    stored = values.copy(order="C" if order == "C" else "F")
    save(tmp_path / "x.npz", cube=stored, wavelengths=NM, other=np.zeros((2, 2, 2)))
    cube = open_cube(tmp_path / "x.npz")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    save(tmp_path / "y.npz", anything=stored)
    check_reads(open_cube(tmp_path / "y.npz"), values)
    save(tmp_path / "z.npz", one=stored, two=stored)
    with pytest.raises(CubeFormatError) as caught:
        open_cube(tmp_path / "z.npz")
    assert caught.value.details["variables"] == ["one", "two"]


@pytest.mark.parametrize(
    "options", [{}, {"chunks": (3, 2, 4)}, {"chunks": (1, 5, 11), "compression": "gzip", "shuffle": True}]
)
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
@pytest.mark.parametrize("dtype", ["u2", ">f4", "i4"])
def test_hdf5(tmp_path: Path, options: dict[str, Any], axes: tuple[int, ...], dtype: str) -> None:
    values = random_values(np.dtype(dtype).newbyteorder("=").str)
    options = dict(options)
    if "chunks" in options:
        options["chunks"] = tuple(options["chunks"][a] for a in axes)
    with h5py.File(tmp_path / "x.h5", "w", userblock_size=512) as f:
        f.create_dataset("scan/cube", data=values.transpose(axes).astype(dtype), **options)
        f["scan/wavelength_um"] = NM / 1e3
    cube = open_cube(tmp_path / "x.h5")
    check_reads(cube, values)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)
    assert cube.warnings == ()


def test_hdf5_unpacked_where_chunks_do_not_suit_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = random_values("u2")
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f.create_dataset("cube", data=values.transpose(2, 0, 1), chunks=(1, 7, 5), compression="gzip")
        f["wavelength"] = NM
    monkeypatch.setattr("specimap.core.cube.hdf._LARGEST_CHUNK_ROW", 100)
    monkeypatch.setattr("specimap.core.cube.scratch.IN_MEMORY_BYTES", 100)
    check_reads(open_cube(tmp_path / "x.h5"), values)


def test_hdf5_reflectance_scale_and_guessed_axes(tmp_path: Path) -> None:
    values = random_values("u2")
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f["Reflectance"] = values
        f["Reflectance"].attrs["Scale_Factor"] = 10000.0
    cube = open_cube(tmp_path / "x.h5")
    check_reads(cube, values)
    assert cube.to_reflectance == pytest.approx(1e-4)
    assert [code for code, _ in cube.warnings] == ["axes_assumed", "wavelengths_missing"]


def test_hdf5_does_not_leave_its_file(tmp_path: Path) -> None:
    values = random_values("u1")
    (tmp_path / "secret").write_bytes(values.tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as f:
        f["cube"] = values
    with h5py.File(tmp_path / "x.h5", "w") as f:
        f.create_dataset("cube", values.shape, "u1", external=[(str(tmp_path / "secret"), 0, values.nbytes)])
    with h5py.File(tmp_path / "y.h5", "w") as f:
        f["cube"] = h5py.ExternalLink("other.h5", "/cube")
    with h5py.File(tmp_path / "z.h5", "w") as f:
        layout = h5py.VirtualLayout(values.shape, "u1")
        layout[...] = h5py.VirtualSource(str(tmp_path / "other.h5"), "cube", values.shape)
        f.create_virtual_dataset("cube", layout)
    for name in ("x.h5", "y.h5", "z.h5"):
        with pytest.raises(CubeFormatError):
            open_cube(tmp_path / name)


def test_hdf5_truncated(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as f:
        f["cube"] = random_values("f8")
    whole = path.stat().st_size
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CubeTruncatedError) as caught:
        open_cube(path)
    assert caught.value.details == {"expected_bytes": whole, "found_bytes": whole - 100}


@pytest.mark.parametrize("options", [{}, {"chunks": (4, 5, 3), "compression": "gzip"}])
def test_matlab73(tmp_path: Path, options: dict[str, Any]) -> None:
    values = random_values("u2")
    with h5py.File(tmp_path / "x.mat", "w", userblock_size=512) as f:
        f.create_dataset("cube", data=values.T, **options).attrs["MATLAB_class"] = np.bytes_("uint16")
        f.create_dataset("wavelengths", data=NM[None]).attrs["MATLAB_class"] = np.bytes_("double")
    cube = open_cube(tmp_path / "x.mat")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    assert cube.format_name == "MATLAB 7.3"


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("packed", [False, True])
def test_matlab5(tmp_path: Path, dtype: str, packed: bool) -> None:
    values = random_values(dtype)
    content = {"note": "text", "img": values, "wl": NM, "gt": np.zeros((7, 5)), "s": {"a": [1, 2]}, "z": 1j}
    scipy_io.savemat(tmp_path / "x.mat", content, do_compression=packed)
    cube = open_cube(tmp_path / "x.mat")
    check_reads(cube, values)
    np.testing.assert_array_equal(cube.wavelengths_nm, NM)
    assert cube.warnings == ()


@pytest.mark.parametrize("dtype", ["i2", "i4", "f4", "f8"])
@pytest.mark.parametrize("axes", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
def test_netcdf3(tmp_path: Path, dtype: str, axes: tuple[int, ...]) -> None:
    values = random_values(dtype)
    with scipy_io.netcdf_file(tmp_path / "x.nc", "w") as f:
        for name, size in zip(("y", "x", "band"), values.shape, strict=True):
            f.createDimension(name, size)
        f.createVariable("data", dtype, tuple(("y", "x", "band")[a] for a in axes))[:] = values.transpose(axes)
        wavelength = f.createVariable("wavelength", "f8", ("band",))
        wavelength[:] = NM / 1e3
        wavelength.units = "micrometers"
    cube = open_cube(tmp_path / "x.nc")
    check_reads(cube, values)
    np.testing.assert_allclose(cube.wavelengths_nm, NM)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i2", "f4"])
@pytest.mark.parametrize("layout", ["pages", "contig", "planar", "packed", "separate"])
@pytest.mark.parametrize("order", "<>")
def test_tiff(tmp_path: Path, dtype: str, layout: str, order: str) -> None:
    values = random_values(dtype)
    path = tmp_path / "x.tif"
    pages = np.ascontiguousarray(values.transpose(2, 0, 1))
    if layout == "separate":
        with tifffile.TiffWriter(path, byteorder=order) as writer:
            for page in pages:
                writer.write(page, photometric="minisblack", contiguous=False, metadata=None)
    elif layout == "contig":
        tifffile.imwrite(path, values, photometric="minisblack", planarconfig="contig", byteorder=order)
    elif layout == "planar":
        tifffile.imwrite(path, pages, photometric="minisblack", planarconfig="separate", byteorder=order)
    else:
        packing = "zlib" if layout == "packed" else None
        tifffile.imwrite(
            path, pages, photometric="minisblack", compression=packing, byteorder=order,
            metadata={"wavelengths": NM.tolist()},
        )  # fmt: skip
    cube = open_cube(path)
    check_reads(cube, values)
    if layout in ("pages", "packed"):
        np.testing.assert_allclose(cube.wavelengths_nm, NM)


def test_tiff_truncated(tmp_path: Path) -> None:
    path = tmp_path / "x.tif"
    pages = random_values("u2", (40, 30, 11)).transpose(2, 0, 1)
    tifffile.imwrite(path, pages, photometric="minisblack", metadata=None)
    whole = path.read_bytes()
    with tifffile.TiffWriter(path) as writer:
        for page in pages:
            writer.write(page, photometric="minisblack", contiguous=False, metadata=None)
    for content in (whole, path.read_bytes()):
        for kept in (0.3, 0.5, 0.8):
            path.write_bytes(content[: int(kept * len(content))])
            with pytest.raises(CubeTruncatedError):
                open_cube(path)


@pytest.mark.parametrize("name", ["x.npy", "x.npz", "x.h5", "x.nc", "x.mat", "x.tif", "x.raw", "x.hdr"])
def test_damaged_files_are_refused_or_read(tmp_path: Path, name: str) -> None:
    """Cut and bit-flipped files end in a typed error, never in another exception."""
    values = random_values("i2")
    whole = tmp_path / name
    if name == "x.npy":
        np.save(whole, values)
    elif name == "x.npz":
        np.savez_compressed(whole, cube=values, wavelengths=NM)
    elif name == "x.h5":
        with h5py.File(whole, "w") as f:
            f.create_dataset("cube", data=values, chunks=(2, 5, 11), compression="gzip")
    elif name == "x.nc":
        with scipy_io.netcdf_file(whole, "w") as f:
            for axis, size in zip("yxb", values.shape, strict=True):
                f.createDimension(axis, size)
            f.createVariable("data", "i2", tuple("yxb"))[:] = values
    elif name == "x.mat":
        scipy_io.savemat(whole, {"cube": values}, do_compression=True)
    elif name == "x.tif":
        tifffile.imwrite(whole, values.transpose(2, 0, 1), photometric="minisblack")
    else:
        write_envi(tmp_path / "x.hdr", values, wavelength="{" + ",".join(map(str, NM)) + "}")
    content = whole.read_bytes()
    rng = np.random.default_rng(5)
    refused = 0
    for trial in range(60):
        damaged = bytearray(content[: rng.integers(1, len(content))] if trial % 2 else content)
        for at in rng.integers(0, min(len(damaged), 2000), 8):
            damaged[at] ^= 1 << int(rng.integers(0, 8))
        whole.write_bytes(damaged)
        try:
            cube = open_cube(whole)
            cube.read_rows(0, cube.rows)
        except SpecimapError:
            refused += 1
    assert refused >= 15, refused


# ---- calibration ----------------------------------------------------------------------------------------


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
    assert "dark_missing" in dict(without_dark.warnings)


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
    assert "2 of 55" in dict(cube.warnings)["reference_invalid"]
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


# ---- content --------------------------------------------------------------------------------------------


def codes(tmp_path: Path, values: Values, **extra: Any) -> set[str]:
    cube = open_cube(write_envi(tmp_path / "x.hdr", values, **extra))
    return {code for code, _ in inspect(cube, cube.mean_image())}


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


# ---- real files -----------------------------------------------------------------------------------------

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
    assert [code for code, _ in wrong.warnings] == ["wavelengths_count_mismatch"]
    right = open_cube(folder / "plantcv_headwall/darkReference.hdr")
    assert right.wavelengths_nm[[0, 1]].tolist() == [379.027, 379.663]
    assert right.quantity == "counts"
    corn = open_cube(folder / "plantcv_headwall/corn-kernel-hyperspectral.hdr")
    assert corn.wavelengths_nm[[0, -1]].tolist() == [366.551, 1048.421]
    assert [code for code, _ in corn.warnings] == ["byte_order_assumed"]
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
    assert "reference_invalid" not in dict(sample.warnings)
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

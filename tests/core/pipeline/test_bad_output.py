"""Impossible settings, output folders and disks that refuse, the unforeseen: a code, nothing lost, no traceback."""

from __future__ import annotations

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from specimap_core.errors import PhotosNotConnectedError, SpecimapError
from specimap_core.register.registration import Registered, register_cube
from tests.support.scenes import Finished, OnDisk, run_refused, specimap, tree_of

# ---- settings, refused before anything is read ----------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--edge-mm", "0"), "setting_invalid"),
        (("--edge-mm", "nan"), "setting_invalid"),
        (("--edge-mm", "0.03"), "setting_invalid"),
        (("--edge-mm", "300"), "setting_invalid"),
        (("--edge-mm", "inf"), "setting_invalid"),
        (("--r-pc", "1e-5"), "setting_invalid"),
        (("--r-pc", "21"), "setting_invalid"),
        (("--r-reg", "1e300"), "setting_invalid"),
        (("--working-px", "100"), "setting_invalid"),
        (("--working-px", "100000"), "setting_invalid"),
        (("--r-pc", "0"), "setting_invalid"),
        (("--r-reg", "-1"), "setting_invalid"),
        (("--working-px", "0"), "setting_invalid"),
        (("--dictionary", "DICT_5X4_50"), "marker_dictionary_unknown"),
    ],
)
def test_impossible_settings(tmp_path: Path, options: tuple[str, str], code: str) -> None:
    refusal = run_refused(tmp_path / "no photos", tmp_path / "no cube", tmp_path / "out", *options)
    assert refusal["code"] == code
    assert not (tmp_path / "out").exists()


# ---- the output folder ----------------------------------------------------------------------------------


def test_output_folders_that_cannot_be_used(small: OnDisk, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    assert run_refused(small.photos, small.header, file)["code"] == "output_exists"
    assert run_refused(small.photos, small.header, file / "below")["code"] in ("output_exists", "output_not_writable")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("mine")
    assert run_refused(small.photos, small.header, foreign)["code"] == "output_exists"
    assert (foreign / "thesis.txt").read_text() == "mine"
    assert len(list(foreign.iterdir())) == 1
    latin = tmp_path / os.fsdecode(b"m\xfcller") / "out"
    refusal = run_refused(small.photos, small.header, latin)
    assert refusal["code"] == "output_not_writable"
    assert "m\ufffdller" in str(refusal["message"])
    assert not latin.parent.exists()
    assert run_refused(small.photos, small.header, Path("/proc/specimap"))["code"] in (
        "output_not_writable",
        "not_found",
    )


@pytest.fixture(scope="module")
def registered_once() -> Iterator[None]:
    """The same cube is registered to the same surface once in a module: no disk takes part in that."""
    found = list[Registered]()

    def register_once(*arguments: Any, **named: Any) -> Registered:
        if not found:
            found.append(register_cube(*arguments, **named))
        return found[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("specimap_core.pipeline.register_stage.register_cube", register_once)
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("registered_once")
@pytest.mark.parametrize("step", ["write_mesh_ply", "write_cloud", "write_preview"])
def test_a_disk_that_refuses_leaves_the_earlier_results(
    small: OnDisk, finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    from specimap_core.pipeline import register_stage

    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)
    for number, code in ((errno.ENOSPC, "storage_full"), (errno.EACCES, "output_not_writable")):

        def refuse(*_: object, number: int = number, **__: object) -> None:
            raise OSError(number, os.strerror(number))

        with monkeypatch.context() as patched:
            patched.setattr(register_stage, step, refuse)
            assert run_refused(small.photos, small.header, out, "--r-pc", "1.0")["code"] == code
        assert tree_of(out) == before
    assert specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--r-pc", "1.0").status == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")
def test_a_disk_that_fills_up(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    need = sum(p.stat().st_size for p in finished.out.rglob("*") if p.is_file())
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={need + 200_000}", "tmpfs", str(disk)], check=False)
    if made.returncode:
        pytest.skip("this machine does not let one mount a small disk")
    try:
        out = finished.copy_to(disk / "out")
        before = tree_of(out)
        assert run_refused(small.photos, small.header, out, "--r-pc", "1.0")["code"] == "storage_full"
        assert tree_of(out) == before
        assert not list(out.glob(".*.tmp"))
    finally:
        subprocess.run(["umount", str(disk)], check=True)


# ---- anything else --------------------------------------------------------------------------------------


def test_an_unforeseen_error_is_told_without_a_traceback(
    small: OnDisk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from specimap_core.pipeline import run

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("nobody thought of [this]")

    monkeypatch.setattr(run, "run_pipeline", fail)
    arguments = ("run", "--photos", small.photos, "--cube", small.header, "--out", tmp_path / "out")
    answer = specimap(*arguments)
    assert answer.status == 1
    assert "internal_error" in answer.err
    assert "[this]" in answer.err
    assert "SPECIMAP_DEBUG" in answer.err


def test_errors_in_words_go_to_standard_error(tmp_path: Path) -> None:
    answer = specimap("run", "--photos", tmp_path / "[no]", "--cube", "none.hdr", "--out", tmp_path / "out")
    assert answer.status == 2
    assert answer.out == ""
    assert "not_found" in answer.err
    assert "[no]" in answer.err
    assert "Name the folder" in answer.err


def test_every_refusal_is_a_specimap_error() -> None:
    error = PhotosNotConnectedError("m", advice="a", photos=["x"])
    assert isinstance(error, SpecimapError)
    assert error.as_dict() == {
        "code": "photos_not_connected",
        "message": "m",
        "advice": "a",
        "details": {"photos": ["x"]},
    }

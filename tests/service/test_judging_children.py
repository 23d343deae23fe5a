"""The checks of a judging child's answer, and the child that a bad file costs."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from specimap_infra.settings import load_settings
from specimap_service.acquisitions.judge import Judge
from specimap_service.acquisitions.verdicts import LONGEST_TEXT, MOST_ITEMS, checked_verdict
from tests.support.worker_scene import until

PHOTO = {
    "verdict": "accepted",
    "code": None,
    "reason": "",
    "advice": "",
    "suffix": ".jpg",
    "width": 512,
    "height": 512,
    "sharpness": 0.01,
    "marker_ids": [0, 1],
    "dictionary_seen": None,
}
WHOLE = {"verdict": "accepted", "code": None, "reason": "", "advice": "", "suffix": ".h5", "part": "whole"}


@pytest.mark.parametrize(
    "answer",
    [
        None,
        [],
        "accepted",
        {"died": True},
        {**PHOTO, "verdict": "fine"},
        {**PHOTO, "suffix": "/../../x"},
        {**PHOTO, "suffix": ".jpg/../x"},
        {**PHOTO, "code": "a b"},
        {**PHOTO, "width": "wide"},
        {**PHOTO, "marker_ids": list(range(MOST_ITEMS + 1))},
        {**PHOTO, "sharpness": float("nan")},
        {**PHOTO, "width": 10**30},
        {**PHOTO, "more": [[[[[1]]]]]},
        {k: v for k, v in PHOTO.items() if k != "suffix"},
    ],
)
def test_an_answer_that_no_reader_gives_is_none(answer: object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - the message is for nobody
        checked_verdict("photo", answer)


def test_an_answer_is_shortened_and_its_wavelengths_are_plausible() -> None:
    verdict = checked_verdict("photo", {**PHOTO, "reason": "a\x1b[31m" + "b" * 5000})
    assert len(verdict["reason"]) <= LONGEST_TEXT
    assert "\x1b" not in verdict["reason"]
    for given, kept in (
        ([400, 1000.5], [400, 1000.5]),
        ([1000, 400], None),
        ([-1.0, 5], None),
        ([0.0, 1e300][:1], None),
        ([1e-9, 2.0], None),
        ([400, 1e9], None),
        ("secret", None),
        ([400, 500, 600], None),
        (None, None),
    ):
        assert checked_verdict("part", {**WHOLE, "wavelength_nm": given})["wavelength_nm"] == kept


POISON = """
import json, os, signal, sys
from specimap_core.screening import process as child
from specimap_core.screening.verdict import Verdict

def poison(task):
    how = task["path"].rpartition("/")[2]
    if how == "crash":
        os.abort()
    if how == "memory":
        bytearray(1 << 40)
    if how in ("twice", "huge"):
        (writing,) = [int(name) for name in range(3, 64) if is_open(name)]
        os.write(writing, (b'{"verdict": "accepted"}\\n' * 2) if how == "twice" else b"x" * 100)
        for _ in range(4000 if how == "huge" else 0):
            os.write(writing, b"x" * 100)
    return Verdict(facts={"pid": os.getpid(), "parent": os.getppid()})

def is_open(descriptor):
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True

child.TASKS["cube"] = poison
child.main()
"""


def test_a_file_costs_its_own_copy_and_no_other_files_answer(tmp_path: Path) -> None:
    judge = Judge(load_settings(data_dir=tmp_path / "data"), os.environ, (sys.executable, "-c", POISON))
    folder = tmp_path / "task"
    folder.mkdir()
    try:
        first = judge.cube(folder / "good")
        for how in ("crash", "memory", "twice", "huge", "crash"):
            assert judge.cube(folder / how)["code"] == "judging_crashed", how
            second = judge.cube(folder / "good")
            assert second["verdict"] == "accepted"
            assert second["pid"] not in (first["pid"], second["parent"])
        # The same two children answered all of it.
        assert len({second["parent"], first["parent"]}) <= 2
        assert not list((tmp_path / "data" / "scratch" / "judging").iterdir())
    finally:
        judge.close()


def test_a_copy_that_ends_while_it_waits_is_no_fault_of_the_next_file(tmp_path: Path) -> None:
    judge = Judge(load_settings(data_dir=tmp_path / "data"), os.environ, (sys.executable, "-c", POISON))
    folder = tmp_path / "task"
    folder.mkdir()
    try:
        child = judge.cube(folder / "good")["parent"]
        children = Path(f"/proc/{child}/task/{child}/children")
        (waiting,) = until(lambda: children.read_text().split(), 20, "the next copy")
        os.kill(int(waiting), signal.SIGKILL)
        # A signal takes a moment, in which the copy could still be given the next file.
        stat = Path(f"/proc/{waiting}/stat")
        until(lambda: not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z", 20, "its end")
        for _ in range(4):  # each of the two children is asked
            assert judge.cube(folder / "good")["verdict"] == "accepted"
    finally:
        judge.close()


def test_photos_of_more_pixels_than_the_setting_are_refused_by_their_header(tmp_path: Path) -> None:
    folder = tmp_path / "task"
    folder.mkdir()
    picture = Image.fromarray(np.zeros((1000, 1001, 3), np.uint8))
    judge = Judge(load_settings(data_dir=tmp_path / "data", max_photo_pixels=1_000_000), os.environ)
    try:
        picture.save(folder / "a", "PNG")
        verdict = judge.photo(folder / "a", "DICT_4X4_50", [], [])
        assert (verdict["verdict"], verdict["code"]) == ("refused", "photo_too_large")
        assert "1001 x 1000" in verdict["reason"]
        assert "JPEG" in verdict["advice"]
        picture.save(folder / "a", "JPEG")  # which comes reduced
        assert judge.photo(folder / "a", "DICT_4X4_50", [], [])["verdict"] == "doubtful"
    finally:
        judge.close()

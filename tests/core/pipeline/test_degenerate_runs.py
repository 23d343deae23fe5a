"""Runs on photos, settings and cubes that cannot work end with a refusal that has a code of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.scenes import UNNAMED, Finished, OnDisk, cube_with, specimap

pytestmark = pytest.mark.slow


Picture = np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
_MIDDLE = np.array([[1, 0, 0], [0, 1, 0]], np.float32)
PHOTOS: dict[str, Callable[[int, list[Picture]], Picture]] = {
    "one picture eight times": lambda k, all_: np.concatenate([all_[0][:-1], all_[0][-1:] // (k + 1)]),
    "one picture, shifted": lambda k, all_: cv2.warpAffine(
        all_[0], _MIDDLE + np.array([[0, 0, 4 * k], [0, 0, 0]], np.float32), all_[0].shape[1::-1]
    ),
    "overexposed": lambda k, all_: np.clip(all_[k].astype(int) * 6, 0, 255).astype(np.uint8),
    "one pixel high": lambda k, all_: all_[k][:1],
}


@pytest.mark.parametrize("kind", sorted(PHOTOS))
def test_photos_that_cannot_work_are_refused_by_name(tiny: OnDisk, tmp_path: Path, kind: str) -> None:
    pictures = [np.asarray(cv2.imread(str(path)), np.uint8) for path in sorted(tiny.photos.iterdir())]
    (tmp_path / "rgb").mkdir()
    for k in range(len(pictures)):
        cv2.imwrite(str(tmp_path / "rgb" / f"{k}.png"), PHOTOS[kind](k, pictures))
    answer = specimap("run", "--photos", tmp_path / "rgb", "--cube", tiny.header, "--out", tmp_path / "out", "--json")
    assert answer.status == 2, answer
    assert answer.refusal["code"] not in UNNAMED
    assert answer.refusal["advice"]


@pytest.mark.parametrize(
    "options",
    [
        ("--r-reg", 1e5),
        ("--r-reg", 500, "--method", "homography"),
        ("--r-pc", 50, "--method", "homography"),
        ("--r-pc", 1e-4),
        ("--edge-mm", 0.03),
        ("--edge-mm", 1e-9),
        ("--edge-mm", 300),
        ("--edge-mm", "nan"),
        ("--working-px", 1),
        ("--working-px", 100_000),
    ],
    ids=str,
)
def test_settings_that_cannot_work_are_refused_by_name(
    finished: Finished, small: OnDisk, tmp_path: Path, options: tuple[object, ...]
) -> None:
    out = finished.copy_to(tmp_path / "out")
    answer = specimap("run", "--photos", small.photos, "--cube", small.header, "--out", out, "--json", *options)
    assert answer.status in (0, 2), answer
    if answer.status:
        assert answer.refusal["code"] not in UNNAMED
        assert answer.refusal["advice"]


Values = np.ndarray[tuple[int, ...], np.dtype[np.uint16]]
CUBES: dict[str, Callable[[Values], Values]] = {
    "one row": lambda c: c[:1],
    "one column": lambda c: c[:, :1],
    "one band": lambda c: c[..., :1],
    "a few pixels": lambda c: c[::20, ::20],
    "every third row": lambda c: c[::3],
    "every fourth column": lambda c: c[:, ::4],
    "half": lambda c: c[:, : c.shape[1] // 2],
    "transposed": lambda c: c.transpose(1, 0, 2),
    "upside down": lambda c: c[::-1],
    "sheared": lambda c: np.stack([np.roll(row, k // 3, axis=0) for k, row in enumerate(c)]),
    "wavy": lambda c: np.stack([np.roll(row, int(6 * np.sin(k / 5)), axis=0) for k, row in enumerate(c)]),
    "two halves": lambda c: np.concatenate([c[: len(c) // 2], c[len(c) // 2 :][::-1]]),
    "inverted": lambda c: c.max() - c,
}


@pytest.mark.parametrize("kind", sorted(CUBES))
def test_cubes_that_cannot_work_are_refused_by_name(
    finished: Finished, small: OnDisk, tmp_path: Path, kind: str
) -> None:
    out = finished.copy_to(tmp_path / "out")
    header = cube_with(CUBES[kind](small.values()), small, tmp_path / "cube")
    answer = specimap("run", "--photos", small.photos, "--cube", header, "--out", out, "--json")
    assert answer.status in (0, 2), answer
    if answer.status:
        assert answer.refusal["code"] not in UNNAMED
        assert answer.refusal["advice"]

"""Bad photos: a stable code, advice, the photos named."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from specimap_core.json_text import json_text
from specimap_core.photos.folder import photo_folder, photo_paths
from specimap_core.photos.reading import AcquisitionSettings, read_photos
from tests.support.broken_sets import copied, image_of, without_markers
from tests.support.photo_files import bomb
from tests.support.scenes import SMALL, OnDisk, run_refused, shared_phantom
from tests.support.shared_folders import SharedFolders


def test_photos_that_are_not_there(small: OnDisk, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run_refused(tmp_path / "none", small.header, out)["code"] == "not_found"
    (tmp_path / "bare").mkdir()
    assert run_refused(tmp_path / "bare", small.header, out)["code"] == "too_few_photos"
    few = copied(small.photos, tmp_path / "few", step=3)
    refusal = run_refused(few, small.header, out)
    assert refusal["code"] == "too_few_photos"
    assert "6" in str(refusal["message"])


def test_photos_that_are_all_bad(small: OnDisk, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(8):
        (photos / f"{k}.jpg").write_text("a letter, not a photo")
    refusal = run_refused(photos, small.header, tmp_path / "out")
    assert refusal["code"] == "photo_unreadable"
    assert "0.jpg" in str(refusal["message"])


def test_names_that_are_no_utf8_are_shown_as_far_as_they_are(small: OnDisk, tmp_path: Path) -> None:
    """As unpacked from an archive of another system."""
    photos = copied(small.photos, tmp_path / "photos")
    first = min(photos.iterdir())
    first.rename(photos / os.fsdecode(b"sch\xf6n.jpg"))
    (photos / os.fsdecode(b"n\xe4chste.jpg")).write_text("a letter")
    (photos / os.fsdecode(b"\xff.txt")).write_text("")
    (photos / os.fsdecode(b"\xfe")).mkdir()
    read, refused = read_photos(photo_paths(photos), AcquisitionSettings())
    assert "sch\ufffdn.jpg" in {p.name for p in read}
    assert len(read) == len(list(small.photos.iterdir()))
    assert [(r.name, r.code) for r in refused] == [("n\ufffdchste.jpg", "photo_unreadable")]
    output = json_text([*(w.message for w in photo_folder(photos).warnings()), refused[0].reason], ensure_ascii=False)
    assert output.encode("utf-8").decode().count("\ufffd") == 3


@pytest.fixture(scope="session")
def stranger(shared_folders: SharedFolders) -> OnDisk:
    """Another layout with other ids."""
    return shared_phantom(shared_folders, replace(SMALL, seed=3, marker_ids=(10, 11, 12, 13)))


@pytest.mark.slow
@pytest.mark.parametrize("second", ["other", "stranger"])
def test_two_scenes(small: OnDisk, second: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    scene: OnDisk = request.getfixturevalue(second)
    photos = copied(small.photos, tmp_path / "photos", stem="a_", step=2)
    copied(scene.photos, photos, stem="b_", step=2)
    refusal = run_refused(photos, small.header, tmp_path / "out")
    assert refusal["code"] == "photos_not_connected"
    details = refusal["details"]
    assert isinstance(details, dict)
    names = details["photos"]
    assert len({n[0] for n in names}) == 1  # those of one scene, wholly
    assert len(names) == 6


@pytest.fixture
def shallow(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, OnDisk], dict[str, str]]:
    """Pose photos without measuring depth; returns the code of each photo that was refused, by name."""
    from specimap_core.photos.folder import photo_paths
    from specimap_core.photos.reading import AcquisitionSettings, read_photos
    from specimap_core.reconstruct.backend import ReconstructSettings, corners_in_photos, detect_in_photos
    from specimap_core.reconstruct.backends import colmap

    monkeypatch.setattr(colmap, "dense_depth", lambda *_, **__: [])

    def pose(folder: Path, phantom: OnDisk) -> dict[str, str]:
        photos, refused = read_photos(photo_paths(folder), AcquisitionSettings())
        settings = ReconstructSettings()
        found = detect_in_photos(photos, settings.dictionary, workers=2, progress=lambda _: None)
        corners = corners_in_photos(photos, found, settings.dictionary)
        answer = colmap.ColmapBackend().reconstruct(photos, corners, settings, workers=2, progress=lambda _: None)
        # Those that are used lie where the truth says: distances between them, which need no common frame.
        views = {Path(n).name: v for n, v in zip(phantom.truth.photo_names, phantom.truth.views, strict=True)}
        posed = [(photos[p].name, pose.centre) for p, pose in zip(answer.photos, answer.poses, strict=True)]
        known = [(views[n].cam_from_world.centre, c) for n, c in posed if n in views]
        true, got = (np.stack(c) for c in zip(*known, strict=True))
        gaps = [np.linalg.norm(c[:, None] - c[None], axis=-1) for c in (true, got)]
        assert np.abs(gaps[0] - gaps[1]).max() < 0.05 * gaps[0].max()
        return {r.name: r.code for r in [*refused, *answer.refused]}

    return pose


Pose = Callable[[Path, OnDisk], dict[str, str]]


@pytest.mark.slow
def test_a_few_foreign_and_bad_photos_are_refused_by_name(
    small: OnDisk, other: OnDisk, stranger: OnDisk, shallow: Pose, tmp_path: Path
) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    shutil.copy(sorted(other.photos.iterdir())[3], photos / "other.jpg")
    shutil.copy(sorted(stranger.photos.iterdir())[3], photos / "stranger.jpg")
    shutil.copy(sorted(small.photos.iterdir())[0], photos / "again.jpg")
    (photos / "letter.jpg").write_text("a letter")
    whole = sorted(small.photos.iterdir())[1].read_bytes()
    (photos / "cut.jpg").write_bytes(whole[: len(whole) // 3])
    bomb(photos / "bomb.png")
    blurred = cv2.GaussianBlur(image_of(photos / "view_005.jpg"), (0, 0), 9)
    cv2.imwrite(str(photos / "view_005.jpg"), blurred)
    refused = shallow(photos, small)
    assert refused.pop("stranger.jpg") in ("photo_foreign", "photo_unlocated")
    # Blurred so much it may be located all the same.
    assert refused.pop("view_005.jpg", "photo_blurred") == "photo_blurred"
    # Of two copies the one that comes first by name stays.
    assert refused == {
        "other.jpg": "photo_foreign",
        "view_000.jpg": "photo_duplicate",
        "letter.jpg": "photo_unreadable",
        "cut.jpg": "photo_unreadable",
        "bomb.png": "photo_unreadable",
    }


@pytest.mark.slow
def test_photos_without_a_marker_are_located_by_features(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    for name in ("view_003.jpg", "view_011.jpg"):
        without_markers(photos / name, small)
    refused = shallow(photos, small)  # checks poses against truth
    assert len(refused) <= 1
    assert set(refused.values()) <= {"photo_unlocated"}


def test_photos_held_both_ways_are_all_used(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    """Portrait and landscape of one camera; the phantom's square photos are cut to show it."""
    photos = copied(small.photos, tmp_path / "photos")
    for k, path in enumerate(sorted(photos.iterdir())):
        image = cv2.imread(str(path))
        assert image is not None
        cut = image[24:360]  # 336 x 384
        cv2.imwrite(str(path), np.ascontiguousarray(np.rot90(cut)) if k % 3 == 0 else cut)
    assert shallow(photos, small) == {}


@pytest.mark.slow
def test_photos_of_every_format_and_turn_are_used(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    """A folder as several programs leave it: each photo in a format of its own, turned as EXIF says."""
    folder = tmp_path / "photos"
    folder.mkdir()
    kinds = [(".jpg", 1), (".tif", 6), (".heic", 8), (".webp", 3), (".avif", 6), (".png", 8), (".TIFF", 8), (".HIF", 6)]
    back = {1: 0, 3: 2, 6: 1, 8: 3}
    for k, path in enumerate(sorted(small.photos.iterdir())):
        suffix, orientation = kinds[k % len(kinds)]
        cut = image_of(path)[24:360, :, ::-1]  # 336 x 384
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        stored = Image.fromarray(np.ascontiguousarray(np.rot90(cut, back[orientation])))
        lossy = {} if suffix.lower() in (".tif", ".tiff", ".png") else {"quality": 95}
        kind = {".hif": "HEIF", ".tiff": "TIFF"}.get(suffix.lower())
        # Under its own name, so that the truth is found.
        stored.save(folder / f"{path.name}{suffix}", kind, exif=exif.tobytes(), **lossy)
    names = [f"{name}{kinds[k % len(kinds)][0]}" for k, name in enumerate(small.truth.photo_names)]
    named = replace(small.truth, photo_names=names)
    assert shallow(folder, OnDisk(small.folder, named)) == {}


def test_two_resolutions_of_one_phone_are_all_used(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, path in enumerate(sorted(small.photos.iterdir())):
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 60
        with Image.open(path) as image:
            size = (288, 288) if k % 2 else image.size
            image.resize(size, Image.Resampling.BOX).save(folder / path.name, quality=95, exif=exif)
    assert shallow(folder, small) == {}

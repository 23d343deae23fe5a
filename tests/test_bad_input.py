"""Whatever is given: a stable code, advice, nothing lost, and never a traceback."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import (
    SMALL,
    Finished,
    OnDisk,
    cube_with,
    phantom_on_disk,
    read_corners,
    run_refused,
    specimap,
    tree_of,
    xyz_image,
)
from test_acquisition import bomb

from specimap.core.accuracy import compare_with_truth
from specimap.core.cloud import Cloud
from specimap.core.errors import PhotosNotConnectedError, SpecimapError
from specimap.core.pipeline import Inputs, PipelineSettings, run_pipeline
from specimap.core.report import Report

Values = NDArray[np.uint16]


def copied(photos: Path, folder: Path, *, stem: str = "", step: int = 1) -> Path:
    """Copy every ``step``-th photo, its name led by ``stem``."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(photos.iterdir())[::step]:
        shutil.copy(path, folder / f"{stem}{path.name}")
    return folder


# ---- photos -------------------------------------------------------------------------------------------


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


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> OnDisk:
    """Another layout with the same ids."""
    return phantom_on_disk(tmp_path_factory.mktemp("other"), replace(SMALL, seed=2, bands=2))


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> OnDisk:
    """Another layout with other ids."""
    return phantom_on_disk(tmp_path_factory.mktemp("stranger"), replace(SMALL, seed=3, marker_ids=(10, 11, 12, 13)))


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
    from specimap.core.acquisition import AcquisitionSettings, photo_paths, read_photos
    from specimap.core.reconstruct import colmap
    from specimap.core.reconstruct.backend import ReconstructSettings, corners_in_photos, detect_in_photos

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
    refused = shallow(photos, small)
    assert refused.pop("stranger.jpg") in ("photo_foreign", "photo_unlocated")
    # Of two copies the one that comes first by name stays.
    assert refused == {
        "other.jpg": "photo_foreign", "view_000.jpg": "photo_duplicate", "letter.jpg": "photo_unreadable",
        "cut.jpg": "photo_unreadable", "bomb.png": "photo_unreadable",
    }  # fmt: skip


def without_markers(path: Path, phantom: OnDisk) -> None:
    """Paint grey over the cards in a photo."""
    image = cv2.imread(str(path))
    assert image is not None
    names = [Path(n).name for n in phantom.truth.photo_names]
    view = phantom.truth.views[names.index(path.name)]
    for corners in phantom.truth.marker_corners:
        middle = corners.mean(0)
        card = np.round(view.project(middle + 1.3 * (corners - middle))).astype(np.int32)
        cv2.fillConvexPoly(image, card, (120, 120, 120))
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 95])


def test_photos_without_a_marker_are_located_by_features(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    for name in ("view_003.jpg", "view_011.jpg"):
        without_markers(photos / name, small)
    refused = shallow(photos, small)  # checks poses against truth
    assert len(refused) <= 1
    assert set(refused.values()) <= {"photo_unlocated"}


def test_a_blurred_photo_is_located_or_refused_by_name(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    image = cv2.imread(str(photos / "view_005.jpg"))
    assert image is not None
    cv2.imwrite(str(photos / "view_005.jpg"), cv2.GaussianBlur(image, (0, 0), 9))
    assert shallow(photos, small) in ({}, {"view_005.jpg": "photo_blurred"})


def test_photos_held_both_ways_are_all_used(small: OnDisk, shallow: Pose, tmp_path: Path) -> None:
    """Portrait and landscape of one camera; the phantom's square photos are cut to show it."""
    photos = copied(small.photos, tmp_path / "photos")
    for k, path in enumerate(sorted(photos.iterdir())):
        image = cv2.imread(str(path))
        assert image is not None
        cut = image[24:360]  # 336 x 384
        cv2.imwrite(str(path), np.ascontiguousarray(np.rot90(cut)) if k % 3 == 0 else cut)
    assert shallow(photos, small) == {}


# ---- markers ------------------------------------------------------------------------------------------


def test_no_marker_anywhere(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    for path in photos.iterdir():
        without_markers(path, small)
    assert run_refused(photos, small.header, tmp_path / "out")["code"] == "no_markers_found"


@pytest.mark.parametrize("given", ["DICT_5X5_50", "DICT_6X6_1000", "DICT_APRILTAG_16h5", "DICT_7X7_1000"])
def test_markers_of_another_dictionary(small: OnDisk, tmp_path: Path, given: str) -> None:
    refusal = run_refused(small.photos, small.header, tmp_path / "out", "--dictionary", given)
    assert refusal["code"] == "marker_dictionary_wrong"
    assert "DICT_4X4_1000" in str(refusal["advice"])


def test_a_layout_of_one_marker_is_refused_at_the_cube(tmp_path: Path) -> None:
    phantom = phantom_on_disk(tmp_path, replace(SMALL, marker_ids=(5,), bands=4))
    refusal = run_refused(phantom.photos, phantom.header, tmp_path / "out")
    assert refusal["code"] == "markers_missing_in_cube"


def test_other_layouts_work(tmp_path: Path) -> None:
    """Nine markers of another dictionary and edge."""
    settings = replace(SMALL, marker_ids=tuple(range(20, 29)), dictionary="DICT_6X6_250", edge_mm=10.0, bands=4,
                       photo_size=512)  # fmt: skip
    phantom = phantom_on_disk(tmp_path, settings)
    pipeline = PipelineSettings()
    pipeline = replace(
        pipeline,
        reconstruct=replace(pipeline.reconstruct, dictionary="DICT_6X6_250", edge_mm=10.0),
        adjust=replace(pipeline.adjust, edge_mm=10.0),
    )
    report = run_pipeline(Inputs(phantom.photos, phantom.header), tmp_path / "out", pipeline)
    ids, corners = read_corners(tmp_path / "out")
    assert len(ids) >= 8
    cloud = Cloud.open(tmp_path / "out" / "cloud.zarr")
    true_corners = phantom.truth.marker_corners[[list(settings.marker_ids).index(i) for i in ids]]
    against = compare_with_truth(
        cloud.hsi_pixel, cloud.xyz, corners, true_corners, phantom.truth.hsi_xyz.astype(float),
        phantom.truth.hsi_class == 1,
    )  # fmt: skip
    assert 0.01 < against.median < 0.4
    assert abs(against.scale) < 0.005
    assert report.edge_length_mm.mean == pytest.approx(10, rel=0.01)


# ---- settings, refused before anything is read --------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("--edge-mm", "0"), "setting_invalid"),
        (("--edge-mm", "nan"), "setting_invalid"),
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


# ---- the cube; stages 1 and 2 are taken over from the finished run ------------------------------------


def rerun(small: OnDisk, out: Path, cube: Path) -> Report:
    report = run_pipeline(Inputs(small.photos, cube), out, PipelineSettings())
    assert report.reused_stages == ["reconstruct", "adjust"]
    return report


def header_edited(small: OnDisk, folder: Path, old: str, new: str, *, data: bool = True) -> Path:
    folder.mkdir()
    text = small.header.read_text()
    assert old in text
    (folder / "hsi.hdr").write_text(text.replace(old, new))
    if data:
        shutil.copy(small.header.with_suffix(".raw"), folder / "hsi.raw")
    return folder / "hsi.hdr"


def test_cubes_that_do_not_open(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)
    folder = tmp_path / "cubes"
    folder.mkdir()
    assert run_refused(small.photos, folder / "none.hdr", out)["code"] == "cube_not_found"
    bare = header_edited(small, folder / "bare", "ENVI", "ENVI", data=False)
    assert run_refused(small.photos, bare, out)["code"] == "cube_not_found"
    typo = header_edited(small, folder / "typo", "interleave = bsq", "interleave = bup")
    refusal = run_refused(small.photos, typo, out)
    assert refusal["code"] == "cube_header_invalid"
    assert refusal["details"]["field"] == "interleave"  # type: ignore[index]
    longer = header_edited(small, folder / "longer", "lines = 128", "lines = 256")
    refusal = run_refused(small.photos, longer, out)
    assert refusal["code"] == "cube_truncated"
    size = small.header.with_suffix(".raw").stat().st_size
    details = refusal["details"]
    assert isinstance(details, dict)
    assert {size, 2 * size} <= set(details.values())
    text = folder / "text.hdr"
    text.write_text("a letter")
    assert str(run_refused(small.photos, text, out)["code"]).startswith("cube_")
    assert tree_of(out) == before


def test_cubes_without_content(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)
    np.save(tmp_path / "nan.npy", np.full((40, 50, 3), np.nan, np.float32))
    assert run_refused(small.photos, tmp_path / "nan.npy", out)["code"] == "cube_content_invalid"
    np.save(tmp_path / "zero.npy", np.zeros((40, 50, 3), np.uint16))
    assert run_refused(small.photos, tmp_path / "zero.npy", out)["code"] == "cube_content_invalid"
    rng = np.random.default_rng(0)
    np.save(tmp_path / "noise.npy", rng.integers(0, 9000, (60, 70, 3), dtype=np.uint16))
    refusal = run_refused(small.photos, tmp_path / "noise.npy", out)
    assert refusal["code"] == "markers_missing_in_cube"
    assert refusal["details"] == {"seen": [], "wanted": [0, 1, 2, 3]}
    assert tree_of(out) == before


def saturated(values: Values) -> Values:
    values[60:70, 70:90] = 65535
    return values


def dark_bands(values: Values) -> Values:
    values[..., 3:6] = 0
    return values


def one_band(values: Values) -> Values:
    return values[..., 2:3]


@pytest.mark.parametrize(
    ("change", "code"), [(saturated, "saturated"), (dark_bands, "bands_all_zero"), (one_band, "single_band")]
)
def test_cubes_with_flaws_are_used_with_a_warning(
    small: OnDisk, finished: Finished, tmp_path: Path, change: Callable[[Values], Values], code: str
) -> None:
    cube = cube_with(change(small.values()), small, tmp_path / "cube")
    report = rerun(small, finished.copy_to(tmp_path / "out"), cube)
    assert code in {w.code for w in report.warnings}
    assert report.coverage.points > 5000


def test_pixels_that_are_not_numbers(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    values = small.values().astype(np.float32) / 10000
    values[50:60, 40:80] = np.nan
    np.savez(tmp_path / "cube.npz", cube=values, wavelengths=small.truth.wavelengths_nm)
    report = rerun(small, finished.copy_to(tmp_path / "out"), tmp_path / "cube.npz")
    assert "pixels_nan" in {w.code for w in report.warnings}
    assert report.corner_2d_mm.mean < 0.1


@pytest.mark.parametrize("how", ["90", "180", "270", "fliplr", "flipud"])
def test_a_turned_or_mirrored_cube_gives_the_same_places(
    small: OnDisk, finished: Finished, tmp_path: Path, how: str
) -> None:
    values = small.values()
    turns = {"90": 1, "180": 2, "270": 3}.get(how, 0)

    def change(image: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.rot90(image, turns) if turns else getattr(np, how)(image)

    out = finished.copy_to(tmp_path / "out")
    report = rerun(small, out, cube_with(np.asarray(change(values), np.uint16), small, tmp_path / "cube"))
    straight = xyz_image(finished.out, values.shape[:2])
    expected = np.asarray(change(straight), np.float32)
    apart = np.linalg.norm(xyz_image(out, (expected.shape[0], expected.shape[1])) - expected, axis=-1)
    both = np.isfinite(apart)
    assert both.mean() > 0.95 * np.isfinite(straight[..., 0]).mean()
    assert np.median(apart[both]) < 0.03
    mirrored = not turns
    assert report.cube_camera.mirrored == mirrored
    assert ("cube_mirrored" in {w.code for w in report.warnings}) == mirrored
    if turns:
        by = (report.cube_camera.roll_deg - finished.report.cube_camera.roll_deg) % 360
        assert min(abs(by - 90 * turns), abs(by - 360 + 90 * turns)) < 1


def hidden(small: OnDisk, ids: tuple[int, ...]) -> Values:
    """Lay something grey over markers in the cube."""
    values = small.values()
    mask = np.zeros(values.shape[:2], np.uint8)
    for i in ids:
        corners = small.truth.marker_corners[i]
        larger = corners.mean(0) + 1.2 * (corners - corners.mean(0))
        cv2.fillConvexPoly(mask, np.round(small.truth.hsi_view.project(larger)).astype(np.int32), 1)
    values[mask > 0] = 3000
    return values


def test_a_marker_hidden_in_the_cube(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    report = rerun(small, out, cube_with(hidden(small, (2,)), small, tmp_path / "one"))
    assert report.inliers.of == 12
    assert report.marker_ids_in_cube == [0, 1, 3]
    (warning,) = [w for w in report.warnings if w.code == "markers_missing_in_cube"]
    assert "12" in warning.message
    before = tree_of(out)
    three = cube_with(hidden(small, (0, 1, 3)), small, tmp_path / "three")
    refusal = run_refused(small.photos, three, out)
    assert refusal["code"] == "markers_missing_in_cube"
    assert refusal["details"] == {"seen": [2], "wanted": [0, 1, 2, 3]}
    assert tree_of(out) == before


# ---- scale --------------------------------------------------------------------------------------------


def test_a_wrong_edge_is_warned_of(small: OnDisk, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    from PIL import ExifTags, Image

    for path in small.photos.iterdir():
        with Image.open(path) as image:
            exif = Image.Exif()
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.SubjectDistance] = 0.15
            image.save(photos / path.name, quality=95, exif=exif)
    answer = specimap(
        "run", "--photos", photos, "--cube", small.header, "--out", tmp_path / "out", "--edge-mm", 68, "--json"
    )
    assert answer.status == 0
    report = Report.model_validate(answer.events[-1]["report"])
    assert {"scale_implausible", "scale_contradicts_exif"} <= {w.code for w in report.warnings}


# ---- the output folder --------------------------------------------------------------------------------


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
    assert run_refused(small.photos, small.header, Path("/proc/specimap"))["code"] in (
        "output_not_writable", "not_found",
    )  # fmt: skip


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, "storage_full"), (errno.EACCES, "output_not_writable")])
@pytest.mark.parametrize("step", ["write_mesh_ply", "write_cloud", "write_preview"])
def test_a_disk_that_refuses_leaves_the_earlier_results(
    small: OnDisk,
    finished: Finished,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    code: str,
    step: str,
) -> None:
    from specimap.core.pipeline import finish

    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(finish, step, refuse)
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


# ---- anything else ------------------------------------------------------------------------------------


def test_an_unforeseen_error_is_told_without_a_traceback(
    small: OnDisk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from specimap.core import pipeline

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("nobody thought of [this]")

    monkeypatch.setattr(pipeline, "run_pipeline", fail)
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
        "code": "photos_not_connected", "message": "m", "advice": "a", "details": {"photos": ["x"]},
    }  # fmt: skip

"""Parametric maps and segmentations: the values of the cloud on the grid of an image with the markers' plane."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydicom import Dataset, dcmread

from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.labels import write_label
from specimap_core.errors import NotFoundError, SettingsError
from specimap_hospital.dicom.build import build_parametric_map, build_segmentation
from specimap_hospital.dicom.model import BandChoice, ResultSource, SegmentClass
from tests.support.dicom_scene import ORDER, dciodvfy, program, said_by, source_of
from tests.support.scenes import Finished

CLASSES = (SegmentClass(1, "Specimen", "#ff0000"), SegmentClass(2, "Märker card"))


@pytest.fixture(scope="module")
def labelled(finished: Finished, tmp_path_factory: pytest.TempPathFactory) -> ResultSource:
    """A run with a layer of classes and one of probabilities."""
    folder = tmp_path_factory.mktemp("labelled") / "out"
    shutil.copytree(finished.out, folder)
    cloud = Cloud.open(folder / "cloud.zarr")
    write_label(folder / "cloud.zarr" / "labels" / "tissue", (cloud.flags & 3).astype(np.uint8))
    share = (cloud.xyz[:, 0] - cloud.xyz[:, 0].min()) / np.ptp(cloud.xyz[:, 0])
    probabilities = np.stack([share, 1 - share], 1).astype(np.float32)
    probabilities[:100] = np.nan
    write_label(folder / "cloud.zarr" / "labels" / "odds", probabilities)
    return source_of(folder, {})


def places(image: Dataset, mapped: Dataset) -> NDArray[np.float64]:
    """x, y (rows, cols, 2) mm of a map's pixels, from what it says of its own plane."""
    shared = mapped.SharedFunctionalGroupsSequence[0]
    origin = [float(v) for v in image.ImagePositionPatient]
    spacing = [float(v) for v in shared.PixelMeasuresSequence[0].PixelSpacing]
    across, down = np.array(shared.PlaneOrientationSequence[0].ImageOrientationPatient, float).reshape(2, 3)
    rows, cols = np.indices((mapped.Rows, mapped.Columns))
    found = np.array(origin) + cols[..., None] * across * spacing[1] + rows[..., None] * down * spacing[0]
    return np.asarray(found[..., :2])


@pytest.mark.slow
def test_a_map_holds_the_bands_where_they_are(labelled: ResultSource, tmp_path: Path) -> None:
    made = build_parametric_map(ORDER, labelled, tmp_path, BandChoice(bands=(2, 9)))
    assert [item.kind for item in made] == ["reference_image", "parametric_map"]
    assert [dciodvfy(item.path) for item in made] == [[], []]
    image, found = (dcmread(item.path) for item in made)
    assert found.FrameOfReferenceUID == image.FrameOfReferenceUID
    for dataset in (image, found):
        assert "not patient axes" in dataset.SeriesDescription
        assert "research" in dataset.SeriesDescription
        assert dataset.SpecimenDescriptionSequence[0].SpecimenIdentifier == "SP-3"
    values = np.frombuffer(found.FloatPixelData, "<f4").reshape(found.NumberOfFrames, found.Rows, found.Columns)
    cloud = Cloud.open(labelled.folder / "cloud.zarr")
    bands = cloud.spectra(slice(None), [2, 9])
    # Each point of a flat place is one of those that its pixel is the mean of.
    where = places(image, found)
    flat = np.flatnonzero((cloud.flags & Flag.MARKER_CARD > 0) & (np.abs(cloud.xyz[:, 2]) < 0.3))
    col = np.rint((cloud.xyz[flat, 0] - where[0, 0, 0]) / 0.1).astype(int)
    row = np.rint((where[0, 0, 1] - cloud.xyz[flat, 1]) / 0.1).astype(int)
    for k in range(2):
        np.testing.assert_allclose(np.median(np.abs(values[k, row, col] - bands[flat, k])), 0, atol=1e-4)
    padding = values == found.FloatPixelPaddingValue
    assert 0.02 < padding.mean() < 0.9
    labels = [group.RealWorldValueMappingSequence[0].LUTLabel for group in found.PerFrameFunctionalGroupsSequence]
    assert labels == [f"{cloud.wavelengths_nm[band]:.1f} nm" for band in (2, 9)]


@pytest.mark.slow
def test_a_map_of_probabilities(labelled: ResultSource, tmp_path: Path) -> None:
    choice = BandChoice(label="odds", columns={1: "Tumör"})
    image, found = (dcmread(item.path) for item in build_parametric_map(ORDER, labelled, tmp_path, choice))
    values = np.frombuffer(found.FloatPixelData, "<f4").reshape(found.Rows, found.Columns)
    known = values != found.FloatPixelPaddingValue
    x = places(image, found)[..., 0][known]
    assert np.corrcoef(x, values[known])[0, 1] < -0.999
    mapping = found.SharedFunctionalGroupsSequence[0].get("RealWorldValueMappingSequence") or (
        found.PerFrameFunctionalGroupsSequence[0].RealWorldValueMappingSequence
    )
    assert mapping[0].LUTExplanation == "Probability of Tumör"


@pytest.mark.slow
def test_a_segmentation_lies_on_the_specimen(labelled: ResultSource, tmp_path: Path) -> None:
    made = build_segmentation(ORDER, labelled, tmp_path, "tissue", CLASSES)
    assert [item.kind for item in made] == ["reference_image", "segmentation"]
    assert [dciodvfy(item.path) for item in made] == [[], []]
    image, found = (dcmread(item.path) for item in made)
    assert found.SpecimenDescriptionSequence[0].SpecimenIdentifier == "SP-3"
    assert [s.SegmentLabel for s in found.SegmentSequence] == ["Specimen", "Märker card"]
    assert "RecommendedDisplayCIELabValue" in found.SegmentSequence[0]
    masks = found.pixel_array.reshape(-1, found.Rows, found.Columns) > 0
    assert not (masks[0] & masks[1]).any()
    cloud = Cloud.open(labelled.folder / "cloud.zarr")
    where = places(image, found)
    middle = cloud.xyz[cloud.flags & Flag.SPECIMEN > 0][:, :2].mean(0)
    assert np.linalg.norm(where[masks[0]].mean(0) - middle) < 1.0
    said = said_by([program("dcmdump"), str(made[1].path)])
    assert "SegmentationStorage" in said


@pytest.mark.slow
def test_another_layer_under_the_same_name_is_another_object(labelled: ResultSource, tmp_path: Path) -> None:
    first = build_segmentation(ORDER, labelled, tmp_path / "a", "tissue", CLASSES)
    again = build_segmentation(ORDER, labelled, tmp_path / "b", "tissue", CLASSES)
    other = build_segmentation(ORDER, labelled, tmp_path / "c", "tissue", CLASSES[:1])
    assert first[1].sop_instance_uid == again[1].sop_instance_uid != other[1].sop_instance_uid
    assert (tmp_path / "a" / "segmentation.dcm").read_bytes() == (tmp_path / "b" / "segmentation.dcm").read_bytes()
    maps = [
        build_parametric_map(ORDER, labelled, tmp_path / name, BandChoice(bands=bands))[1].sop_instance_uid
        for name, bands in (("d", (1,)), ("e", (1,)), ("f", (2,)))
    ]
    assert maps[0] == maps[1] != maps[2]


@pytest.mark.slow
def test_what_there_is_not_is_refused(labelled: ResultSource, tmp_path: Path) -> None:
    for choice, leaf in (
        (BandChoice(), SettingsError),
        (BandChoice(bands=(99,)), NotFoundError),
        (BandChoice(label="none", columns={0: "a"}), NotFoundError),
        (BandChoice(label="odds", columns={7: "a"}), NotFoundError),
        (BandChoice(label="tissue", columns={0: "a"}), SettingsError),
        (BandChoice(bands=tuple([1] * 100_000)), SettingsError),
    ):
        with pytest.raises(leaf) as refusal:
            build_parametric_map(ORDER, labelled, tmp_path, choice)
        assert refusal.value.advice
    for label, classes, leaf in (
        ("none", CLASSES, NotFoundError),
        ("odds", CLASSES, SettingsError),
        ("tissue", (), SettingsError),
        ("tissue", (SegmentClass(77, "nowhere"),), NotFoundError),
    ):
        with pytest.raises(leaf) as refusal:
            build_segmentation(ORDER, labelled, tmp_path, label, classes)
        assert refusal.value.advice
    assert not (tmp_path / "map.dcm").exists()

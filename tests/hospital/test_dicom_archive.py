"""The objects in a real archive: sent by STOW-RS and C-STORE, fetched back equal, and sent again without a trace."""

from __future__ import annotations

import io
from collections.abc import Iterator

import httpx
import pytest
from dicomweb_client.api import DICOMwebClient
from dicomweb_client.session_utils import create_session_from_user_pass
from pydicom import Dataset, dcmread

from tests.support.dicom_scene import ORDER, Built, program, said_by
from tests.support.orthanc import RunningOrthanc, orthanc


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningOrthanc]:
    """An archive besides that of the module, for C-STORE."""
    with orthanc(tmp_path_factory.mktemp("c-store")) as running:
        yield running


def client_of(archive: RunningOrthanc) -> DICOMwebClient:
    session = create_session_from_user_pass(*archive.auth)
    session.trust_env = False
    return DICOMwebClient(archive.dicomweb_url, session=session)


def fetched(archive: RunningOrthanc, uid: str) -> Dataset:
    """An object as the archive gives it, with its file's transfer syntax."""
    found = httpx.post(f"{archive.url}/tools/lookup", content=uid, auth=archive.auth, trust_env=False).json()
    (instance,) = [item["ID"] for item in found if item["Type"] == "Instance"]
    answer = httpx.get(f"{archive.url}/instances/{instance}/file", auth=archive.auth, trust_env=False, timeout=60)
    answer.raise_for_status()
    return dcmread(io.BytesIO(answer.content))


def assert_equal_to_files(archive: RunningOrthanc, built: Built) -> None:
    assert archive.instances() == {made.sop_instance_uid for made in built.objects}
    for made in built.objects:
        kept, sent = fetched(archive, made.sop_instance_uid), dcmread(made.path)
        assert kept.file_meta.TransferSyntaxUID == sent.file_meta.TransferSyntaxUID
        assert kept == sent, made.kind


@pytest.mark.slow
def test_stow_stores_them_and_wado_gives_them_back(archive: RunningOrthanc, first_set: Built) -> None:
    client = client_of(archive)
    answer = client.store_instances([dcmread(made.path) for made in first_set.objects])
    assert len(answer.ReferencedSOPSequence) == 30
    assert not answer.get("FailedSOPSequence")
    assert_equal_to_files(archive, first_set)
    (study,) = client.search_for_studies(search_filters={"AccessionNumber": ORDER.accession_number})
    assert study["0020000D"]["Value"] == [ORDER.study_instance_uid]
    back = client.retrieve_study(ORDER.study_instance_uid or "")
    assert {item.SOPInstanceUID for item in back} == archive.instances()
    photo = first_set.one("photo")
    (same,) = [item for item in back if item.SOPInstanceUID == photo.SOPInstanceUID]
    assert same.PatientName == ORDER.patient_name
    rendered = httpx.get(
        f"{archive.dicomweb_url}/studies/{photo.StudyInstanceUID}/series/{photo.SeriesInstanceUID}"
        f"/instances/{photo.SOPInstanceUID}/rendered",
        headers={"Accept": "image/png"},
        auth=archive.auth,
        trust_env=False,
        timeout=60,
    )
    assert rendered.status_code == 200
    assert rendered.content.startswith(b"\x89PNG")


@pytest.mark.slow
def test_sent_again_they_are_the_same_objects(archive: RunningOrthanc, first_set: Built) -> None:
    before = archive.instances()
    counts = archive.get("/statistics")
    assert before == {made.sop_instance_uid for made in first_set.objects}
    answer = client_of(archive).store_instances([dcmread(made.path) for made in first_set.objects])
    assert len(answer.ReferencedSOPSequence) == 30
    assert archive.instances() == before
    after = archive.get("/statistics")
    assert [after[name] for name in ("CountPatients", "CountStudies", "CountSeries", "CountInstances")] == [1, 1, 7, 30]
    assert after["TotalDiskSize"] == counts["TotalDiskSize"]


@pytest.mark.slow
def test_c_store_stores_them(empty: RunningOrthanc, first_set: Built) -> None:
    files = [str(made.path) for made in first_set.objects]
    # Without -R it proposes a list of its own, which lacks some of the classes; without -xy, no JPEG.
    said_by([program("storescu"), "-R", "-xy", "-aec", empty.aet, "127.0.0.1", str(empty.dicom_port), *files])
    assert_equal_to_files(empty, first_set)


@pytest.mark.slow
def test_a_study_without_a_patient_is_taken_too(empty: RunningOrthanc, unnamed_set: Built) -> None:
    before = empty.instances()
    answer = client_of(empty).store_instances([dcmread(made.path) for made in unnamed_set.objects])
    assert len(answer.ReferencedSOPSequence) == 30
    assert len(empty.instances()) == len(before) + 30

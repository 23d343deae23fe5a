"""De-identified exports: every identifier that a client can plant is gone, and the numbers are what they were."""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from specimap_core.cloud import Cloud
from specimap_core.cube import open_cube
from specimap_core.report.model import read_report
from specimap_infra.ids import new_id
from specimap_infra.settings import load_settings
from specimap_infra.tables import Acquisition, CloudRow, StoredFile
from tests.support.export_scene import address, make
from tests.support.label_files import NPY, layer, npy
from tests.support.planted import (
    MARK,
    PLANTED,
    arrays_in,
    cube_values,
    envi_header,
    exif_with,
    opened,
    photo,
    places_of,
    planted,
)
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving

SECRET = "s" * 40
SUFFIXES = ("jpg", "png", "tif", "heic")
FORMATS = ("deidentified", "deidentified-inputs")


def planted_result(service: Running, client: httpx.Client, folder: Path) -> tuple[Result, list[str]]:
    """A result with identifiers everywhere, and the digests of its files."""
    result = put_result(service, folder, specimen_id=planted("specimen")[:60].replace("^", "."))
    digests = []
    files = {f"photo-{n:04d}.{suffix}": photo(suffix) for n, suffix in enumerate(SUFFIXES, 1)}
    files |= {"cube.hdr": envi_header("cube"), "cube.raw": cube_values()}
    files |= {"white.hdr": envi_header("white"), "white.raw": cube_values()}
    with service.database.session() as session:
        row = session.get_one(Acquisition, result.acquisition_id)
        row.accession_number, row.notes = planted("accession").replace("^", "."), planted("notes")
        for label, data in files.items():
            file_id = new_id("file")
            key = f"acquisitions/{result.acquisition_id}/{file_id}"
            service.storage.put(key, data)
            digests.append(hashlib.sha256(data).hexdigest())
            role = label.split("-")[0].split(".")[0]
            session.add(
                StoredFile(
                    id=file_id,
                    acquisition_id=result.acquisition_id,
                    role=role,
                    label=label,
                    name=planted(f"file-{label}"),
                    size=len(data),
                    sha256=digests[-1],
                    storage_key=key,
                    state="accepted",
                    judgement={"reason": planted("judgement")},
                    created_by="key_test",
                )
            )
    _plant_in_result(service, result.prefix, digests)
    header = {
        "kind": "class",
        "classes": [
            {"value": 0, "name": planted("class-0"), "colour": "#ff0000"},
            {"value": 1, "name": planted("class-1"), "colour": None},
        ],
        "made_by": {"name": planted("made-by"), "version": planted("made-by-version")},
    }
    name = planted("layer").lower().replace("^", "_")
    values = np.arange(result.cloud.n_points) % 2
    answer = client.put(
        layer(result, name),
        content=npy(values.astype(np.uint8)),
        headers={"X-Specimap-Label": json.dumps(header), "Content-Type": NPY},
    )
    assert answer.status_code == 201, answer.text
    return result, digests


def _plant_in_result(service: Running, prefix: str, digests: list[str]) -> None:
    folder = service.storage.path(prefix)
    assert folder is not None
    for place in ("cloud.zarr/zarr.json", "cloud.zarr/spectra/zarr.json", "cloud.zarr/xyz/zarr.json"):
        document = json.loads((folder / place).read_text())
        document["attributes"] |= {"note": planted(place), "inputs": {"cube": digests[0]}, planted("member"): 1}
        (folder / place).write_text(json.dumps(document))
    report = json.loads((folder / "report.json").read_text())
    report["photos"]["used"] = [f"photo-{n:04d}.{suffix}" for n, suffix in enumerate(SUFFIXES[:3], 1)]
    report["photos"]["refused"] = [{"name": planted("refused"), "code": "photo_blurred", "reason": planted("reason")}]
    report["warnings"] = [{"code": "values_clipped", "message": planted("warning")}]
    report["inputs"] = {"photos": digests}
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "notes.txt").write_text(planted("stray"))
    info = PngInfo()
    info.add_text("Comment", planted("preview"))
    with Image.open(folder / "preview.png") as picture:
        picture.load()
        picture.save(folder / "preview.png", pnginfo=info)
        picture.convert("RGB").save(folder / "photos.jpg", exif=exif_with("sheet"), comment=planted("sheet"))


def exported(service: Running, client: httpx.Client, result: Result, format: str) -> tuple[bytes, httpx.Response]:
    asked = client.post(address(result, format))
    assert asked.status_code in (200, 202), asked.text
    if asked.status_code == 202:
        make(service, asked.json()["id"])
    made = client.get(address(result, format)).json()
    assert (made["state"], made["error"]) == ("succeeded", None), made
    answer = client.get(made["links"]["content"])
    return answer.content, answer


def unpacked(data: bytes, folder: Path) -> Path:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        archive.extractall(folder)
    return folder


def identifiers(service: Running, result: Result, digests: list[str]) -> list[str]:
    """What may not be found: the mark that all planted texts hold, ids, hashes, days."""
    with service.database.session() as session:
        row = session.get_one(Acquisition, result.acquisition_id)
        cloud = session.get_one(CloudRow, result.cloud_id)
        ids = [row.id, cloud.id, cloud.job_id, row.project_id, *session.scalars(sa.select(StoredFile.id))]
        days = {str(moment)[:10] for moment in (row.created_at, cloud.created_at)} | {"2026:11:01", "2026-11-01"}
        return [MARK, *PLANTED, row.specimen_id, *ids, *digests, *days]


@pytest.mark.parametrize("format", FORMATS)
def test_nothing_that_was_planted_is_in_the_export(tmp_path: Path, format: str) -> None:
    with serving(tmp_path / "service", pseudonym_secret=SECRET) as service:
        client = service.client()
        result, digests = planted_result(service, client, tmp_path / "result")
        wanted = identifiers(service, result, digests)
        # The search itself finds them, in what is not de-identified.
        originals = [
            part
            for item in service.storage.list(result.prefix)
            for part in opened(item.key, service.storage.read(item.key))
        ]
        assert {MARK, digests[0]} <= {text for text, _ in places_of(wanted, iter(originals))}
        data, answer = exported(service, client, result, format)
        assert places_of(wanted, opened("export.zip", data)) == set()
        folder = unpacked(data, tmp_path / "export")
        assert places_of(wanted, arrays_in(folder)) == set()
        named = re.fullmatch(r'attachment; filename="([a-z2-7]{16})\.(.*)\.zip"', answer.headers["content-disposition"])
        assert named is not None
        facts = json.loads((folder / "export.json").read_text())
        assert (named[1], named[2]) == (facts["result"], format)
        names = {path.relative_to(folder).parts[0] for path in folder.rglob("*")}
        assert names == {"export.json", "result", *(("photos", "cube") if format == FORMATS[1] else ())}
        _check_result(folder / "result", result)
        if format == FORMATS[1]:
            _check_inputs(folder, facts)


def _check_result(folder: Path, result: Result) -> None:
    cloud, before = Cloud.open(folder / "cloud.zarr"), result.cloud
    assert np.array_equal(cloud.stored_spectra(slice(None)), before.stored_spectra(slice(None)))
    assert np.array_equal(cloud.xyz, before.xyz)
    assert np.array_equal(
        cloud.decode(cloud.stored_spectra([0])), before.decode(before.stored_spectra([0])), equal_nan=True
    )
    assert cloud.label_names == ("label-001",)
    assert np.array_equal(cloud.label("label-001"), np.arange(before.n_points) % 2)
    attributes = json.loads((folder / "cloud.zarr" / "labels" / "label-001" / "zarr.json").read_text())["attributes"]
    assert attributes["classes"] == [
        {"value": 0, "name": "class-0", "colour": "#ff0000"},
        {"value": 1, "name": "class-1", "colour": None},
    ]
    report = json.loads((folder / "report.json").read_text())
    assert report["photos"]["used"] == ["photo-001.jpg", "photo-002.jpg", "photo-003.jpg"]
    assert report["photos"]["refused"] == [{"name": None, "code": "photo_blurred", "reason": None}]
    assert report["corner_2d_mm"] == read_report(result.local).model_dump(mode="json")["corner_2d_mm"]


def _check_inputs(folder: Path, facts: dict[str, Any]) -> None:
    assert [entry["name"] for entry in facts["photos"]] == [f"photo-00{n}.jpg" for n in range(1, 5)]
    for path in (folder / "photos").iterdir():
        with Image.open(path) as picture:
            assert picture.size == (128, 96)
            assert set(picture.info) <= {"jfif", "jfif_version", "jfif_unit", "jfif_density"}
            assert dict(picture.getexif()) == {}
    cube = open_cube(folder / "cube" / "cube.hdr")
    assert np.array_equal(cube.read_rows(0, 6), np.frombuffer(cube_values(), "<u2").reshape(6, 4, 5).transpose(0, 2, 1))
    assert list(cube.wavelengths_nm) == [500, 550, 600, 650]
    assert (folder / "cube" / "white.hdr").exists()


def test_pseudonyms_stay_with_the_key_and_change_with_it(tmp_path: Path) -> None:
    found = []
    folder = tmp_path / "service"
    with serving(folder, pseudonym_secret=SECRET) as service:
        client = service.client()
        one = put_result(service, tmp_path / "one", specimen_id="S-7")
        two = put_result(service, tmp_path / "two", specimen_id="S-7")
        for number, result in enumerate((one, two)):
            data, _ = exported(service, client, result, "deidentified")
            found.append(json.loads((unpacked(data, tmp_path / f"x{number}") / "export.json").read_text()))
    with serving(folder, pseudonym_secret="t" * 40) as service:
        data, _ = exported(service, service.client(), one, "deidentified")
        found.append(json.loads((unpacked(data, tmp_path / "x3") / "export.json").read_text()))
    assert found[0]["specimen"] == found[1]["specimen"] != found[2]["specimen"]
    assert found[0]["result"] != found[1]["result"]
    assert found[0]["captured_shifted"] == found[1]["captured_shifted"]
    assert found[0]["made_shifted"] != found[2]["made_shifted"]


def test_without_a_key_there_is_no_such_export(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    refused = service.client().post(address(result, "deidentified"))
    assert (refused.status_code, refused.json()["code"]) == (422, "setting_invalid")
    assert "SPECIMAP_PSEUDONYM_SECRET" in refused.json()["advice"]


def test_a_short_key_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="32 characters"):
        load_settings(data_dir=tmp_path, pseudonym_secret="short")

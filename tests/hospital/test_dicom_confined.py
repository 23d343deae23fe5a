"""The builder's own process: what it reaches, and what becomes of one that dies, lies, or takes too long."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from specimap_core.errors import CancelledError, MemoryExhaustedError, NotFoundError, SpecimapError
from specimap_core.sandbox import protection
from specimap_core.surface.mesh_files import write_mesh_ply
from specimap_hospital.dicom import confined
from specimap_hospital.dicom.confined import Limits, build_confined
from specimap_hospital.dicom.model import BuildTask, LeftOut, ResultSource
from specimap_hospital.dicom.uids import study_uid
from specimap_infra.errors import StageTimeoutError, WorkerCrashedError
from tests.support.dicom_scene import ORDER, PATIENT_WORDS, source_of
from tests.support.document_scene import folder_of
from tests.support.photo_files import pattern, written
from tests.support.scenes import bump_mesh

Fake = Callable[[str], None]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> ResultSource:
    folder = folder_of(tmp_path_factory.mktemp("confined") / "out")
    write_mesh_ply(folder / "mesh.ply", bump_mesh(size_mm=20.0))
    photos = folder.parent / "photos"
    photos.mkdir()
    return source_of(folder, {"a.jpg": written(photos / "a.jpg", pattern(), "JPEG"), "b.jpg": photos / "b.jpg"})


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Let a program stand for the process; it finds its request in ``request``, and ``say`` writes a line."""

    def stand_in(program: str) -> None:
        head = "import json, sys, time, os\nrequest = json.loads(sys.stdin.readline())\n"
        head += "def say(**line): print(json.dumps(line), flush=True)\n"
        monkeypatch.setattr(confined, "confined", lambda *_: [sys.executable, "-c", head + program])

    return stand_in


@pytest.mark.slow
def test_it_builds_where_it_reaches_nothing_else(source: ResultSource, tmp_path: Path) -> None:
    if not protection().whole:
        pytest.skip(f"this kernel offers no {protection().missing}")
    shares: list[float] = []
    told: list[LeftOut] = []
    out = tmp_path / "out"
    made = build_confined(
        BuildTask(archive="all.zip"),
        ORDER,
        source,
        out,
        Limits(sandbox="require", memory_bytes=8 << 30),
        progress=shares.append,
        left_out=told.append,
    )
    assert {item.kind for item in made} == {
        *("photo", "top_view", "preview", "mesh", "measurements", "report", "key_objects")
    }
    assert shares == sorted(shares)
    assert shares[-1] > 0.5
    assert [photo.photo for photo in told] == [2]
    assert (out / "all.zip").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


@pytest.mark.slow
def test_it_cannot_read_what_it_is_not_given(source: ResultSource, tmp_path: Path) -> None:
    if not protection().whole:
        pytest.skip(f"this kernel offers no {protection().missing}")
    secret = written(tmp_path / "secret.jpg", pattern(), "JPEG")
    link = tmp_path / "photos" / "a.jpg"
    link.parent.mkdir()
    link.write_bytes(secret.read_bytes())
    # Swapped after the rules were made would be the attack; a folder's neighbour is the same question.
    given = source_of(source.folder, {"a.jpg": link})
    hidden = source_of(source.folder.parent / "elsewhere", {"a.jpg": link})
    assert [m.kind for m in build_confined(BuildTask(), ORDER, given, tmp_path / "o", Limits("require"))].count(
        "photo"
    ) == 1
    with pytest.raises(NotFoundError):
        build_confined(BuildTask(), ORDER, hidden, tmp_path / "p", Limits("require"))


@pytest.mark.slow
def test_a_refusal_comes_back_as_it_was(source: ResultSource, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no report") as refusal:
        build_confined(BuildTask(), ORDER, source_of(tmp_path, {}), tmp_path / "out")
    assert refusal.value.advice


@pytest.mark.slow
def test_too_little_memory_is_said(source: ResultSource, tmp_path: Path) -> None:
    with pytest.raises((MemoryExhaustedError, WorkerCrashedError)) as refusal:
        build_confined(BuildTask(), ORDER, source, tmp_path / "out", Limits(memory_bytes=300 << 20))
    assert refusal.value.advice


def test_it_ends_when_it_is_cancelled_or_too_slow(source: ResultSource, tmp_path: Path, fake: Fake) -> None:
    fake("open(request['out'] + '/pid', 'w').write(str(os.getpid())); time.sleep(60)")
    begun = time.monotonic()
    asked = iter([False, False, *[True] * 9])
    with pytest.raises(CancelledError):
        build_confined(BuildTask(), ORDER, source, tmp_path / "a", cancelled=lambda: next(asked))
    with pytest.raises(StageTimeoutError):
        build_confined(BuildTask(), ORDER, source, tmp_path / "b", Limits(seconds=1.5))
    assert time.monotonic() - begun < 20
    pid = int((tmp_path / "b" / "pid").read_text(encoding="ascii"))
    assert not Path(f"/proc/{pid}").exists()


def test_what_progress_raises_ends_it(source: ResultSource, tmp_path: Path, fake: Fake) -> None:
    fake("say(progress=0.5); time.sleep(60)")

    def stop(share: float) -> None:
        if share:
            raise CancelledError("enough")

    with pytest.raises(CancelledError, match="enough"):
        build_confined(BuildTask(), ORDER, source, tmp_path / "a", progress=stop)


@pytest.mark.parametrize("program", ["os.kill(os.getpid(), 9)", "sys.exit(3)", "pass"])
def test_a_process_that_dies_is_said(source: ResultSource, tmp_path: Path, fake: Fake, program: str) -> None:
    fake(program)
    with pytest.raises(WorkerCrashedError) as refusal:
        build_confined(BuildTask(), ORDER, source, tmp_path / "a")
    assert not [word for word in PATIENT_WORDS if word in json.dumps(refusal.value.as_dict(), ensure_ascii=False)]


@pytest.mark.parametrize(
    "answer",
    [
        {"objects": 7},
        {"objects": [{}]},
        {"objects": ["x"]},
        {"objects": [{"kind": "photo", "path": "/etc/passwd"}]},
        {"objects": [{"kind": "virus"}]},
        {"objects": [{"study_uid": "1.2.3"}]},
        {"objects": [{"sop_instance_uid": "x" * 99}]},
        {"objects": [{"path": "OUT/link"}]},
        {"objects": [{"path": "OUT/../mesh.ply"}]},
        {"error": {}},
        {"error": "x"},
        {"progress": "x"},
        {"left_out": {"photo": "x"}},
        "no object",
    ],
)
def test_an_answer_that_lies_is_refused(source: ResultSource, tmp_path: Path, fake: Fake, answer: Any) -> None:
    out = tmp_path / "a"
    honest = {
        "sop_class_uid": "1.2.840.10008.5.1.4.1.1.7",
        "sop_instance_uid": "2.25.1",
        "series_uid": "2.25.2",
        "study_uid": study_uid(ORDER, source),
        "kind": "photo",
        "path": f"{out}/photo.dcm",
    }
    if isinstance(answer, dict) and isinstance(answer.get("objects"), list) and isinstance(answer["objects"][0], dict):
        given = {name: str(value).replace("OUT", str(out)) for name, value in answer["objects"][0].items()}
        answer = {"objects": [{**honest, **given} if given else {}]}
    fake(
        "open(request['out'] + '/photo.dcm', 'w').close(); os.symlink('/etc/passwd', request['out'] + '/link')\n"
        f"print({json.dumps(json.dumps(answer))}, flush=True); time.sleep(5)"
    )
    with pytest.raises(WorkerCrashedError):
        build_confined(BuildTask(), ORDER, source, out)


def test_an_honest_answer_is_taken(source: ResultSource, tmp_path: Path, fake: Fake) -> None:
    fake(
        "path = request['out'] + '/photo.dcm'; open(path, 'w').close(); say(progress=0.5)\n"
        "say(objects=[dict(sop_class_uid='1.2', sop_instance_uid='2.25.1', series_uid='2.25.2', kind='photo',"
        " path=path, study_uid=request['context']['study_instance_uid'])])"
    )
    (made,) = build_confined(BuildTask(), ORDER, source, tmp_path / "a")
    assert made.path == (tmp_path / "a").resolve() / "photo.dcm"


def test_the_patient_is_not_on_the_command_line(
    source: ResultSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []

    def watch(command: list[str], *_: object) -> list[str]:
        seen.append(command)
        return [sys.executable, "-c", "pass"]

    monkeypatch.setattr(confined, "confined", watch)
    with pytest.raises(SpecimapError):
        build_confined(BuildTask(), ORDER, source, tmp_path / "a")
    assert not [word for word in PATIENT_WORDS if word in " ".join(seen[0])]

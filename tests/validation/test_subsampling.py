"""``specimap study subsampling``: rows that survive an interruption, refusals as rows, figures and a page."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from PIL import Image
from typer.testing import CliRunner

from specimap_cli.validation import study_app
from specimap_core.errors import CancelledError, CubeNotFoundError, OutputExistsError, SettingsError
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.plotting import PRINT_DPI, WIDTH_IN
from specimap_validation import subsampling
from specimap_validation.capture import find_capture
from specimap_validation.pages import publish_study
from specimap_validation.runs import Outcome
from specimap_validation.subsampling import FILE, Row, Study, plan, study_subsampling
from specimap_validation.tables import STUDY_HEADINGS, study_table
from tests.support.scenes import OnDisk
from tests.support.study_outcomes import REFUSED, outcome

SETTINGS = PipelineSettings()

app = typer.Typer()
app.add_typer(study_app, name="study")


def test_the_plan_runs_all_photos_once() -> None:
    assert plan((50, 100, 90, 90), 2) == [(100, 1), (90, 1), (90, 2), (50, 1), (50, 2)]
    for shares, seeds in (((), 1), ((0,), 1), ((101,), 1), ((100,), 0)):
        with pytest.raises(SettingsError):
            plan(shares, seeds)


@pytest.mark.slow
def test_a_real_study_has_rows_and_refusals(small: OnDisk, tmp_path: Path) -> None:
    out = tmp_path / "study"
    arguments = ["study", "subsampling", str(small.folder), "--out", str(out), "--seeds", "1", "--json"]
    answer = CliRunner().invoke(app, [*arguments, "--shares", "100,25"])
    assert answer.exit_code == 0, answer.output
    events = [json.loads(line) for line in answer.stdout.splitlines()]
    runs = [e for e in events if e["event"] == "run"]
    assert [(r["share"], r["photos"]) for r in runs] == [(100, 12), (25, 3)]
    figures = runs[0]["outcome"]["figures"]
    assert 0.01 < figures["truth"]["median_mm"] < 0.25
    assert 0.001 < figures["corner_2d_mm"]["mean"] < 0.05
    assert 0.001 < figures["corner_3d_mm"]["median"] < 0.2
    assert runs[1]["outcome"]["refusal"]["code"] == "too_few_photos"
    shares = [e["share"] for e in events if e["event"] == "progress"]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert all(e["stage"] == "study" for e in events if e["event"] == "progress")
    assert events[-1]["event"] == "finished"
    assert sorted(Path(f).name for f in events[-1]["files"]) == sorted(
        ["subsampling.html", *(f"subsampling_{d}d.{kind}" for d in (2, 3) for kind in ("png", "svg"))]
    )
    stored = Study.model_validate_json((out / FILE).read_text("utf-8"))
    assert stored.model_dump(mode="json") == events[-1]["result"]
    assert stored.has_truth
    # Nothing of the runs stays behind.
    assert not [p for p in out.iterdir() if p.is_dir()]
    # Once more, for a person: nothing is run again.
    answer = CliRunner().invoke(app, [*arguments[:-1], "--shares", "100,25"])
    assert answer.exit_code == 0, answer.output
    assert "too_few_photos" in answer.stdout
    assert Study.model_validate_json((out / FILE).read_text("utf-8")) == stored
    # Other settings are another study.
    answer = CliRunner().invoke(app, [*arguments, "--edge-mm", "7"])
    assert answer.exit_code == 2
    assert json.loads(answer.stdout.splitlines()[-1])["code"] == "output_exists"


PROGRAM = (
    "import typer; from specimap_cli.validation import study_app; "
    "app = typer.Typer(); app.add_typer(study_app, name='study'); app()"
)


@pytest.mark.slow
def test_ctrl_c_ends_a_study_in_order(small: OnDisk, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "study", "subsampling", str(small.folder), "--out", str(tmp_path), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if json.loads(line)["share"] > 0:
            break
    assert any(p.is_dir() for p in tmp_path.iterdir()), "a run is under way"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert json.loads(out.splitlines()[-1])["code"] == "cancelled"
    assert "Traceback" not in err
    assert [p.name for p in tmp_path.iterdir()] == [".specimap"]


# ---- interruption, with runs that cost nothing --------------------------------------------------------


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, list[str]]]:
    """Which runs were made: number of photos, their names."""
    made: list[tuple[int, list[str]]] = []

    def run(inputs: object, out: Path, *_: object, progress: Callable[[float], None], **__: object) -> Outcome:
        photos = sorted(p.name for p in (out.parent / "photos").iterdir())
        assert all((out.parent / "photos" / name).is_file() for name in photos)
        progress(0.5)
        made.append((len(photos), photos))
        return outcome(0.02) if len(photos) >= 6 else REFUSED

    monkeypatch.setattr(subsampling, "run_and_judge", run)
    return made


def test_an_interrupted_study_goes_on(small: OnDisk, tmp_path: Path, ran: list[tuple[int, list[str]]]) -> None:
    capture, out = find_capture(small.folder), tmp_path / "study"
    heard: list[Row] = []

    def stop(row: Row) -> None:
        heard.append(row)
        if len(heard) == 2:
            raise CancelledError("Stopped.")

    with pytest.raises(CancelledError):
        study_subsampling(capture, out, SETTINGS, shares=(100, 80, 60), seeds=2, on_row=stop)
    assert len(ran) == 2
    assert len(Study.model_validate_json((out / FILE).read_text("utf-8")).rows) == 2
    study = study_subsampling(capture, out, SETTINGS, shares=(100, 80, 60), seeds=2, on_row=heard.append)
    assert [(row.share, row.seed) for row in heard] == [(100, 1), (80, 1), (80, 2), (60, 1), (60, 2)]
    assert study.rows == heard
    assert [n for n, _ in ran] == [12, 10, 10, 7, 7]
    assert ran[1][1] != ran[2][1], "another seed, other photos"
    # More seeds later: what is there stays.
    study = study_subsampling(capture, out, SETTINGS, shares=(60,), seeds=3)
    assert len(ran) == 6
    assert [(row.share, row.seed) for row in study.rows][-2:] == [(60, 2), (60, 3)]
    assert len(study.rows) == 6


def test_a_stop_within_a_run_leaves_nothing_behind(
    small: OnDisk, tmp_path: Path, ran: list[tuple[int, list[str]]]
) -> None:
    def stop(share: float) -> None:
        if share > 0.6:
            raise CancelledError("Stopped.")

    with pytest.raises(CancelledError):
        study_subsampling(find_capture(small.folder), tmp_path, SETTINGS, shares=(100, 50), seeds=1, progress=stop)
    assert len(ran) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == [".specimap", FILE]


def test_a_study_is_not_mixed_with_another(small: OnDisk, tmp_path: Path, ran: list[tuple[int, list[str]]]) -> None:
    capture = find_capture(small.folder)
    study_subsampling(capture, tmp_path / "a", SETTINGS, shares=(100,), seeds=1)
    other = replace(SETTINGS, register=replace(SETTINGS.register, method="homography"))
    with pytest.raises(OutputExistsError, match="other photos"):
        study_subsampling(capture, tmp_path / "a", other, shares=(100,), seeds=1)
    (tmp_path / "a" / FILE).write_text('{"schema_version": 2}', "utf-8")
    with pytest.raises(OutputExistsError, match="this version"):
        study_subsampling(capture, tmp_path / "a", SETTINGS, shares=(100,), seeds=1)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputExistsError):
        study_subsampling(capture, tmp_path / "b", SETTINGS, shares=(100,), seeds=1)
    with pytest.raises(CubeNotFoundError):
        study_subsampling(
            replace(capture, cube=tmp_path / "absent.hdr"), tmp_path / "c", SETTINGS, shares=(100,), seeds=1
        )
    assert len(ran) == 1


# ---- pages --------------------------------------------------------------------------------------------


def made_up(*rows: Row, has_truth: bool = True) -> Study:
    return Study(
        specimap_version="0",
        acquisition="SP <1>",
        key="k",
        photos=20,
        has_truth=has_truth,
        method="camera",
        adjustment="rigid",
        rows=list(rows),
    )


@pytest.mark.slow
def test_the_page_needs_nothing_else(tmp_path: Path) -> None:
    rows = [Row(share=s, seed=k, photos=s // 5, outcome=outcome(0.02 * (1 + k))) for s in (100, 90, 50) for k in (1, 2)]
    study = made_up(*rows, Row(share=25, seed=1, photos=5, outcome=REFUSED))
    written = publish_study(study, tmp_path)
    page = (tmp_path / "subsampling.html").read_text("utf-8")
    assert page.count("<svg") == 2
    assert "SP &lt;1&gt;" in page
    assert "too_few_photos" in page
    assert page.count("<tr>") == 8
    # Namespaces of SVG are names, not places.
    assert not re.findall(r'(?:src|href)="(?!#)[^"]*"', page.replace("xlink:href", "href"))
    for path in written:
        assert path.stat().st_size > 3000
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert image.width == round(WIDTH_IN * PRINT_DPI)
    again = {p.name: p.read_bytes() for p in written}
    assert {p.name: p.read_bytes() for p in publish_study(study, tmp_path)} == again


@pytest.mark.slow
def test_a_study_without_truth_or_without_a_single_run_is_drawn_too(tmp_path: Path) -> None:
    for name, study in (
        ("a", made_up(Row(share=100, seed=1, photos=20, outcome=outcome(0.02, truth=False)), has_truth=False)),
        ("b", made_up(Row(share=25, seed=1, photos=5, outcome=REFUSED))),
        ("c", made_up()),
    ):
        (tmp_path / name).mkdir()
        assert len(publish_study(study, tmp_path / name)) == 5


def test_every_run_is_a_line_of_the_table() -> None:
    rows = [Row(share=90, seed=2, photos=18, outcome=outcome(0.02)), Row(share=20, seed=1, photos=4, outcome=REFUSED)]
    table = study_table(rows)
    assert all(len(line) == len(STUDY_HEADINGS) for line in table.rows)
    assert table.rows[0] == (
        "90 %",
        "2",
        "20 of 18",
        "0.002 ± 0.001",
        "0.020 (0.010-0.040)",
        "0.060, 0.18",
        "99.0 %",
        "12.5",
    )
    assert table.rows[1][:4] == ("20 %", "1", "0 of 4", "too_few_photos")

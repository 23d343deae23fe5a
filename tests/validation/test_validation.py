"""``specimap validate``: cases, variants that share their stages, tables with the true error next to the published."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from specimap_cli import validation as evidence
from specimap_core.errors import CancelledError, NotFoundError, OutputExistsError, SettingsError, StorageFullError
from specimap_validation import cases as cases_module
from specimap_validation import validation as v
from specimap_validation.cases import DEFECTS, MOVED, QUICK, QUICK_DEFECTS, Case, cases
from specimap_validation.pages import markdown, publish_validation
from specimap_validation.phantom import PhantomSettings
from specimap_validation.runs import Outcome
from specimap_validation.tables import VALIDATION_HEADINGS, validation_tables
from specimap_validation.validation import AS_PUBLISHED, DEFAULT, FILE, VARIANTS, Row, Validation, validate
from tests.support.scenes import OnDisk
from tests.support.study_outcomes import REFUSED, outcome

TINY = replace(QUICK, photos=10, photo_size=384, cube_rows=160, cube_cols=200, mesh_divisions=64)
NOTHING = PhantomSettings(photos=1, photo_size=32, cube_rows=16, cube_cols=16, bands=2, mesh_divisions=4)

app = typer.Typer()
app.command()(evidence.validate)


def test_cases_are_defects_with_every_seed() -> None:
    found = cases((1, 5), (), quick=False)
    assert len(found) == 2 * len(DEFECTS)
    assert {case.defect for case in found} == set(DEFECTS)
    assert all(case.settings is not None and case.settings.seed == case.seed for case in found)
    plain = found[0].settings
    assert plain is not None
    for case in found[2:]:
        assert case.settings is not None
        assert replace(case.settings, seed=1) != plain, f"{case.defect} changes nothing"
    quick = cases((1,), (), quick=True)
    assert [case.defect for case in quick] == list(QUICK_DEFECTS)
    (moved,) = (case.settings for case in quick if case.defect == MOVED)
    assert moved is not None
    assert moved.moved


def test_an_acquisition_without_truth_validates_nothing(small: OnDisk, tmp_path: Path) -> None:
    (named,) = (case for case in cases((1,), (small.folder,), quick=True) if case.capture is not None)
    assert named.defect == small.folder.name
    for name in ("rgb", "hsi"):
        (tmp_path / name).symlink_to(small.folder / name)
    with pytest.raises(NotFoundError, match=r"truth\.npz"):
        cases((1,), (tmp_path,), quick=True)
    with pytest.raises(SettingsError):
        cases((-1,), (), quick=True)


@pytest.mark.slow
def test_a_real_validation_of_one_phantom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases_module, "QUICK", TINY)
    monkeypatch.setattr(cases_module, "QUICK_DEFECTS", ("none",))
    page, out = tmp_path / "page.md", tmp_path / "validation"
    page.write_text("# Accuracy\n\n<!-- validation -->\n<!-- /validation -->\n", "utf-8")
    arguments = ["--out", str(out), "--quick", "--seeds", "4,5", "--update-docs", str(page)]
    answer = CliRunner().invoke(app, [*arguments, "--json"])
    assert answer.exit_code == 0, answer.output
    events = [json.loads(line) for line in answer.stdout.splitlines()]
    runs = [Row.model_validate({k: x for k, x in e.items() if k != "event"}) for e in events if e["event"] == "run"]
    assert [(r.method, r.adjustment) for r in runs] == list(VARIANTS)
    assert {(r.defect, r.seed) for r in runs} == {("none", 4)}
    truths = {(r.method, r.adjustment): r.outcome.figures for r in runs}
    ours, published = truths[DEFAULT], truths[AS_PUBLISHED]
    assert ours is not None
    assert published is not None
    assert ours.truth is not None
    assert published.truth is not None
    # Parallax: the published registration is worse on tissue though not at the corners.
    assert 0.01 < ours.truth.median_mm < 0.3 < published.truth.median_mm < 1.5
    assert 0.001 < published.corner_2d_mm.mean < 0.05
    assert published.seconds > 0
    assert ours.certified is not None
    assert ours.certified.verdict == "trusted"
    assert events[-1]["event"] == "finished"
    assert {Path(f).name for f in events[-1]["files"]} > {"validation.html", "validation.md", "page.md"}
    assert not [p for p in out.iterdir() if p.is_dir()]
    written = page.read_text("utf-8")
    assert written.startswith("# Accuracy\n\n<!-- validation -->\nSpecimap ")
    assert "| none | camera, rigid | " in written
    stored = Validation.model_validate_json((out / FILE).read_text("utf-8"))
    assert stored.rows == runs
    # Once more, for a person: nothing is run again.
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    assert "By form of the method" in answer.stdout
    assert Validation.model_validate_json((out / FILE).read_text("utf-8")) == stored
    assert page.read_text("utf-8") == written


def test_refused_before_any_work(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("no marks", "utf-8")
    for arguments in (["--update-docs", str(page)], ["--seeds", "one"], ["--acquisition", str(tmp_path / "absent")]):
        answer = CliRunner().invoke(app, ["--out", str(tmp_path / "out"), "--quick", "--json", *arguments])
        assert answer.exit_code == 2
        assert json.loads(answer.stdout.splitlines()[-1])["event"] == "refused"
    assert not (tmp_path / "out").exists()


# ---- interruption, with runs that cost nothing --------------------------------------------------------

Ran = list[tuple[int, str, str]]


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> Ran:
    """Which runs were made: size of the phantom, method, adjustment."""
    made: Ran = []

    def run(inputs: object, out: Path, settings: object, truth: Path, **told: Callable[[float], None]) -> Outcome:
        made.append((sum(1 for _ in (truth / "rgb").iterdir()), settings.register.method, settings.adjust.form))  # type: ignore[attr-defined]
        assert settings.adjust.edge_mm == 5.0  # type: ignore[attr-defined]
        told["progress"](1.0)
        return outcome(0.02)

    monkeypatch.setattr(v, "run_and_judge", run)
    return made


def phantoms(*photos: int) -> list[Case]:
    return [Case(f"{n} photos", 1, replace(NOTHING, photos=n, edge_mm=5.0)) for n in photos]


def test_an_interrupted_validation_goes_on(tmp_path: Path, ran: Ran) -> None:
    heard: list[Row] = []

    def stop(row: Row) -> None:
        heard.append(row)
        if len(heard) == 5:
            raise CancelledError("Stopped.")

    with pytest.raises(CancelledError):
        validate(phantoms(1, 2, 3), tmp_path, on_row=stop)
    assert len(ran) == 8
    shares: list[float] = []
    found = validate(phantoms(1, 2, 3), tmp_path, progress=shares.append)
    assert [n for n, _, _ in ran] == [1] * 4 + [2] * 4 + [3] * 4
    assert [(m, a) for _, m, a in ran[:4]] == list(VARIANTS)
    assert [row.defect for row in found.rows] == [f"{n} photos" for n in (1, 2, 3) for _ in VARIANTS]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # Another set of cases drops what it does not ask for, and takes over what it does.
    found = validate(phantoms(4, 2), tmp_path)
    assert len(ran) == 16
    assert [row.defect for row in found.rows] == [f"{n} photos" for n in (4, 2) for _ in VARIANTS]


def test_a_stop_is_heard_while_a_phantom_is_made(tmp_path: Path, ran: Ran) -> None:
    asked: list[int] = []

    def cancelled() -> bool:
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(CancelledError):
        validate(phantoms(9), tmp_path, cancelled=cancelled)
    assert not ran
    assert [p.name for p in tmp_path.iterdir()] == [".specimap"]


def test_a_full_disk_ends_the_validation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> Outcome:
        raise StorageFullError("The disk is full.")

    monkeypatch.setattr(v, "run_and_judge", full)
    with pytest.raises(StorageFullError):
        validate(phantoms(1), tmp_path)
    (tmp_path / FILE).write_text("{}", "utf-8")
    with pytest.raises(OutputExistsError):
        validate(phantoms(1), tmp_path)


# ---- tables -------------------------------------------------------------------------------------------


def rows_of(defect: str, seed: int, result: Outcome) -> list[Row]:
    return [Row(defect=defect, seed=seed, method=m, adjustment=a, key=defect, outcome=result) for m, a in VARIANTS]


def test_tables_pool_seeds_and_show_the_worst(tmp_path: Path) -> None:
    rows = [
        *rows_of("none", 1, outcome(0.02)),
        *rows_of("none", 2, outcome(0.03)),
        *rows_of("none", 3, outcome(0.07)),
        *rows_of("blur", 1, REFUSED),
        *rows_of(MOVED, 1, outcome(0.5)),
    ]
    validation = Validation(specimap_version="0", quick=False, rows=rows)
    by_case, by_form = validation_tables(validation)
    assert all(len(line) == len(VALIDATION_HEADINGS) for table in (by_case, by_form) for line in table.rows)
    refused = "blur, refused: too_few_photos (1 of 1)"
    names = [line[0] for line in by_case.rows]
    assert names == ["Bicchi et al. (2026), two specimens", "none", "none", refused, refused, MOVED, MOVED]
    none = dict(zip(VALIDATION_HEADINGS, by_case.rows[1], strict=True))
    assert none["registration, adjustment"] == "camera, rigid"
    assert none["2D corner mm: mean ± sd"].startswith("0.004 ± ")
    assert none["3D corner mm: median (quartiles)"] == "0.030 (0.015-0.060)"
    assert none["true error mm: median"] == "0.090 [0.210]"
    assert none["true error mm: p95"] == "0.27 [0.63]"
    assert none["scale"] == "-0.10 %"
    assert none["within 1, 2 sigma"] == "70 %, 95 %"
    assert none["certificate, mm seen"] == "trusted, 0.060 [0.140]"
    # A moved specimen is no fault of a registration: it stays out of the comparison of the forms.
    assert [line[1] for line in by_form.rows] == [f"{m}, {a}" for m, a in VARIANTS]
    assert all("0.210" in line[5] and "1.500" not in line[5] for line in by_form.rows)
    text = markdown(validation)
    assert "seeds 1, 2, 3" in text
    assert "rank 4 runs as the true medians do: Spearman 1.00" in text
    assert text.count("\n|---|") == 2
    written = publish_validation(validation, tmp_path)
    assert len(written) == 8
    page = (tmp_path / "validation.html").read_text("utf-8")
    assert page.count("<svg") == 3
    assert "blur, refused: too_few_photos (1 of 1)" in page

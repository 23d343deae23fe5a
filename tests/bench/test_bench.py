"""The benchmarks' own arithmetic: what they print must be what was measured."""

from __future__ import annotations

import re
import sys
import threading
import types
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import pytest

from bench.accuracy import cases
from bench.growth import (
    DISK_SHARE,
    FACTORS,
    MEMORY_SHARE,
    SPARE_BYTES,
    exponents,
    lacking,
    shape_of,
    sheet_growth,
)
from bench.machine import OPTIONAL, available_bytes, describe, installed
from bench.measure import Cost, Measured
from bench.photos import COUNTS, sheet_photos
from bench.program import PARTS
from bench.step_bounds import BOUNDS, Recorded, Recorder, on_threads
from bench.steps import END, ORDER, REST, START, imports_in, sheet_steps, steps_of
from bench.synthetic import COLS, ROWS
from bench.tables import ACCURACY, MARKS, OF_RUNS, run_tables, sample_sentences
from bench.tracing import TARGETS, Spent, Target, owner_of, tracing
from specimap_validation import validation
from specimap_validation.page_marks import check_marks


class _Clock:
    """A clock that moves only when told to: wall and CPU seconds."""

    def __init__(self) -> None:
        self.wall = self.cpu = 0.0

    def pass_by(self, wall: float, cpu: float) -> None:
        self.wall += wall
        self.cpu += cpu

    def perf_counter(self) -> float:
        return self.wall

    def process_time(self) -> float:
        return self.cpu


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """Stands in for a part of the product: ``outer`` takes 7 s, of which ``inner`` 2 s and ``hidden`` 4 s."""
    clock, module = _Clock(), types.ModuleType("work")

    def inner() -> str:
        clock.pass_by(2, 3)
        return "inner"

    def hidden() -> None:
        clock.pass_by(4, 4)

    def outer() -> str:
        clock.pass_by(1, 2)
        module.hidden()
        found: str = module.inner()
        return found

    for function in (inner, hidden, outer):
        setattr(module, function.__name__, function)
    monkeypatch.setitem(sys.modules, "work", module)
    monkeypatch.setattr("bench.tracing.time", clock)
    return module


TARGETS_OF_WORK = (
    Target("outer", "work", "outer"),
    Target("inner", "work", "inner", splits=True),
    Target("hidden", "work", "hidden"),
)


def test_a_second_within_two_steps_counts_once(work: types.ModuleType) -> None:
    with tracing(TARGETS_OF_WORK) as tracer:
        assert work.outer() == "inner"
        work.inner()
    # What is hidden in outer does not split it.
    assert tracer.steps == {"outer": Spent(5, 6, 1), "inner": Spent(4, 6, 2)}


def test_a_step_of_its_own_is_timed_and_other_threads_are_not(work: types.ModuleType) -> None:
    with tracing(TARGETS_OF_WORK) as tracer:
        thread = threading.Thread(target=work.inner)
        thread.start()
        thread.join()
        work.hidden()
    assert tracer.steps == {"hidden": Spent(4, 4, 1)}


def test_a_step_that_fails_is_timed_and_wrappers_go(work: types.ModuleType) -> None:
    def fail() -> None:
        raise ValueError("on purpose")

    work.outer = fail  # type: ignore[attr-defined]
    with tracing(TARGETS_OF_WORK) as tracer, pytest.raises(ValueError, match="on purpose"):
        work.outer()
    assert tracer.steps["outer"].calls == 1
    assert work.outer is fail


def test_a_target_that_is_gone_is_said_and_the_others_are_put_back(work: types.ModuleType) -> None:
    before = work.outer
    with (
        pytest.raises(AttributeError, match="elsewhere"),
        tracing((*TARGETS_OF_WORK, Target("gone", "work", "elsewhere"))),
    ):
        pass
    assert work.outer is before


@pytest.mark.parametrize("target", TARGETS, ids=lambda t: f"{t.module}.{t.name}")
def test_the_steps_of_a_run_are_where_the_product_has_them(target: Target) -> None:
    owner, name = owner_of(target)
    assert callable(getattr(owner, name))


def test_steps_rest_and_ends_add_up_to_the_run() -> None:
    run = Measured(
        {"start": Cost(1.0, 0.9), "reconstruct": Cost(4.0, 6.0), "adjust": Cost(2.0, 3.0)},
        Cost(7.5, 9.9),
        {
            "steps": {
                "fusion": {"wall_s": 1.5, "cpu_s": 2.5, "calls": 1},
                "reading photos": {"wall_s": 3.0, "cpu_s": 5.0, "calls": 1},
            }
        },
    )
    steps = steps_of(run)
    assert list(steps) == [START, "reading photos", "fusion", REST, END]
    assert steps[REST] == pytest.approx({"wall_s": 1.5, "cpu_s": 1.5})
    assert steps[END]["wall_s"] == pytest.approx(0.5)
    assert sum(s["wall_s"] for s in steps.values()) == pytest.approx(run.whole.wall_s)
    assert sum(s["cpu_s"] for s in steps.values()) == pytest.approx(run.whole.cpu_s)
    assert set(steps) < set(ORDER)
    case = {"steps": steps, "bounds": {START: {"wall_s": 0.5}, "fusion": {"wall_s": 0.75, "cpu_s": 1.0}}}
    (sheet,) = sheet_steps({"repeats": 1, "imports": {"all": 1.0}, "cases": {"made up": case}})
    assert sheet.rows[0] == [START, "1.00", "13.3 %", "0.90", "0.50", "50 %", "-", "-"]
    assert ["fusion", "1.50", "20.0 %", "2.50", "0.75", "50 %", "1.00", "40 %"] in sheet.rows
    assert sheet.rows[-1][:4] == ["whole", "7.50", "100 %", "9.90"]


def test_calls_are_made_as_before_and_can_be_made_again() -> None:
    made: list[tuple[int, int]] = []

    class Library:
        name = "a library"

        def compute(self, a: int, b: int) -> int:
            made.append((a, b))
            return a + b

    calls: list[Callable[[], object]] = []
    recorder = Recorder(Library(), "compute", calls)
    assert recorder.name == "a library"
    assert (recorder.compute(1, 2), recorder.compute(3, 4)) == (3, 7)
    on_threads(calls)
    assert made[:2] == [(1, 2), (3, 4)]
    assert sorted(made[2:]) == [(1, 2), (3, 4)]
    with pytest.raises(ZeroDivisionError):
        on_threads([lambda: 1 // 0])


def test_a_part_of_the_look_ups_is_scaled_by_their_samples() -> None:
    assert Recorded(samples=[(100, True), (300, False), (200, False), (50, True)]).scale == pytest.approx(650 / 150)


def test_every_bound_is_of_a_step() -> None:
    assert set(BOUNDS) < set(ORDER)


def test_imports_are_summed_by_whose_they_are() -> None:
    output = (
        "import time: self [us] | cumulative | imported package\n"
        "import time:      1000 |       1000 |   numpy.linalg\n"
        "import time:      2000 |       3000 | specimap_core\n"
        "a warning | 7 | of something else\n"
        "import time:       500 |        500 | specimapper\n"
    )
    assert imports_in(output) == pytest.approx({"all": 0.0035, "outside": 0.0015})


def test_the_exponent_of_a_power_is_that_power_and_a_fixed_cost_lowers_it() -> None:
    sizes = [12, 24, 48, 96]
    costs = [{"wall_s": 0.1 * n**1.2, "cpu_s": 3.0 * n, "peak_mb": 100 + n} for n in sizes]
    found = exponents(sizes, costs)
    assert found["wall"] == pytest.approx({"all": 1.2, "last": 1.2})
    assert found["cpu"] == pytest.approx({"all": 1.0, "last": 1.0})
    assert 0 < found["memory"]["all"] < found["memory"]["last"] < 1


def test_the_cubes_are_as_large_as_they_are_called() -> None:
    assert shape_of(1.0) == (ROWS, COLS)
    for factor in FACTORS:
        rows, cols = shape_of(factor)
        assert rows % 2 == cols % 2 == 0
        # Rounding moves each side by one pixel at most.
        assert rows * cols == pytest.approx(factor * ROWS * COLS, abs=rows + cols + 1)
        assert cols / rows == pytest.approx(COLS / ROWS, abs=2 / rows)


def test_what_does_not_fit_is_left_out_with_the_reason() -> None:
    size = 3_000_000_000
    disk, memory = DISK_SHARE * size + SPARE_BYTES, MEMORY_SHARE * size + SPARE_BYTES
    assert lacking(size, int(disk), int(memory)) is None
    assert "GB of disk wanted" in (lacking(size, int(disk) - 1, int(memory)) or "")
    assert "GB of memory wanted" in (lacking(size, int(disk), int(memory) - 1) or "")
    skipped = {"rows": 2, "cols": 2, "bytes": size, "skipped": "no room"}
    (sheet,) = sheet_growth({"repeats": 1, "sizes": {"4": skipped}})
    assert sheet.rows[0][0] == "4"
    assert len(sheet.rows[0]) == len(sheet.headings)
    assert "no room" in " ".join(sheet.notes)


def test_the_fastest_run_of_each_number_of_photos_is_printed() -> None:
    def run(wall: float) -> dict[str, object]:
        cost = {"wall_s": wall, "cpu_s": wall, "peak_mb": wall}
        return {"whole": cost, "stages": {"reconstruct": cost, "adjust": cost}, "result": {"photos": [7, 9]}}

    slope = {"all": 1.5, "last": 1.0}
    figures = {"repeats": 2, "exponent": {"wall": slope}, "runs": {str(n): [run(2.0 * n), run(n)] for n in COUNTS}}
    (sheet,) = sheet_photos(figures)
    assert sheet.rows[0] == ["12", "7", "12.0", "12.0", "12.0", "12.0", "12"]
    assert sheet.notes[-1].endswith("met: NO.")


def test_the_machine_names_optional_packages_only_where_they_are() -> None:
    assert installed(("numpy", "no-such-package-of-this-name")) == {"numpy": version("numpy")}
    versions = describe()["versions"]
    assert isinstance(versions, dict)
    assert {name for name in OPTIONAL if name in versions} == set(installed(OPTIONAL))
    assert available_bytes() > 0


@pytest.mark.parametrize(
    ("page", "mark"),
    [*((page, mark) for page, marks in MARKS.items() for mark in marks), (ACCURACY, validation.MARK)],
    ids=lambda part: getattr(part, "name", part),
)
def test_each_generated_text_has_its_place(page: Path, mark: str) -> None:
    assert f"<!-- {mark} -->" in check_marks(page, mark)


def test_each_table_of_a_run_comes_from_a_part() -> None:
    assert set(OF_RUNS) < set(PARTS)


def test_the_readme_states_the_errors_of_both_registrations_on_the_sample() -> None:
    case = {"camera": {"median_mm": 0.0478, "p95_mm": 0.284}, "homography": {"median_mm": 0.541, "p95_mm": 1.899}}
    sentences = sample_sentences({"sample": case})
    assert re.findall(r"\d\.\d+", sentences) == ["0.048", "0.28", "0.54", "1.90"]


def test_a_table_of_the_page_says_what_it_was_measured_on() -> None:
    skipped = {"rows": 2, "cols": 4, "bytes": 3_000_000_000, "skipped": "no room"}
    machine = {"cores": 3, "cpu": "a processor", "memory_gb": 5, "python": "3.11", "load_before": 0.5}
    figures = {"repeats": 1, "sizes": {"4": skipped}, "load_after": 0.75}
    output = run_tables("growth", {"figures": figures, "machine": machine, "time": "2026-01-02T03:04:05+00:00"})
    assert "| 4 | 4 x 2 | 3.00 | - | - | - | - | - | - |" in output
    assert output.endswith("3 x a processor, 5 GB, Python 3.11, load 0.5 before, 0.75 after; 2026-01-02.")


def test_path_traced_phantoms_in_the_test_data_are_judged_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name in ("noisy_2", "clean_1", "empty"):
        (tmp_path / "path_traced" / name).mkdir(parents=True)
    for name in ("noisy_2", "clean_1"):
        (tmp_path / "path_traced" / name / "truth.npz").touch()
    found = [case for case in cases(tmp_path, tmp_path / "work") if case.name.startswith("path-traced")]
    assert [case.name for case in found] == ["path-traced clean_1", "path-traced noisy_2"]
    assert found[0].folder == tmp_path / "path_traced" / "clean_1"

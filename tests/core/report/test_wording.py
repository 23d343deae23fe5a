"""The report in words: a verdict that fits the figures, and an advice for everything that a run can complain of."""

from __future__ import annotations

import pytest

from specimap_core.notices import Notice
from specimap_core.report.model import Refused, SigmaFigures
from specimap_core.report.wording import REFUSAL_ADVICE, checks, placement_sentence, verdict
from tests.support.document_scene import full_report
from tests.support.error_tables import table_of


def test_every_documented_refusal_has_its_advice() -> None:
    assert table_of("Photos that are not used") <= set(REFUSAL_ADVICE)


def test_verdicts() -> None:
    report = full_report(10)
    output = verdict(report)
    assert (output.level, output.actions) == ("good", ())
    assert "All 3 photos were used." in output.sentences
    warned = report.model_copy(update={"warnings": [Notice(code="few_photos", message="Few.")]})
    assert verdict(warned).level == "note"
    assert "with the warnings below" in verdict(warned).title

    lost = [Refused(name=f"{k}.jpg", code="photo_blurred", reason="Blurred.") for k in range(3)]
    bad = report.model_copy(
        update={
            "photos": report.photos.model_copy(update={"given": 6, "refused": lost}),
            "marker_ids_in_cube": [0, 1],
            "leave_one_marker_out_mm": None,
            "coverage": report.coverage.model_copy(update={"between_markers": 0.97}),
        }
    )
    output = verdict(bad)
    assert output.level == "attention"
    assert "4 of 6 checks failed" in output.title
    assert "3 of 6 photos were not used (3 blurred)." in output.sentences
    assert "0.jpg, 1.jpg, 2.jpg" in output.actions[0]
    assert "marker 2, 3 in view" in output.actions[1]
    board = report.model_copy(update={"marker_ids": list(range(30)), "marker_ids_in_cube": list(range(5))})
    assert all(check.good for check in checks(board))


@pytest.mark.parametrize(
    ("median", "said"),
    [(0.123, "about 0.1 mm"), (0.087, "about 0.09 mm"), (2.4, "about 2 mm"), (float("nan"), "not known")],
)
def test_how_places_are_put_in_words(median: float, said: str) -> None:
    report = full_report(10).model_copy(update={"sigma_mm": SigmaFigures(median=median, p95=2 * median)})
    assert said in placement_sentence(report)

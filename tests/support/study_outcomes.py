"""Outcomes of a study's runs."""

from __future__ import annotations

from specimap_core.register.figures import Quartiles, Spread
from specimap_validation.runs import AgainstTruth, Certified, Figures, Outcome, Refusal


def outcome(level: float, *, truth: bool = True) -> Outcome:
    """Made-up figures."""
    return Outcome(
        figures=Figures(
            photos_given=20,
            photos_used=20,
            corner_2d_mm=Spread(mean=level / 10, std=level / 30, n=16),
            corner_3d_mm=Quartiles(median=level, q1=level / 2, q3=level * 2, n=16),
            leave_one_marker_out_mm=level / 5,
            seconds=12.5,
            warnings=[],
            truth=AgainstTruth(
                median_mm=level * 3,
                p95_mm=level * 9,
                coverage=0.99,
                scale=-0.001,
                within_1_sigma=0.7,
                within_2_sigma=0.95,
            )
            if truth
            else None,
            certified=Certified(verdict="trusted", seen_median_mm=level * 2, seen_p95_mm=level * 8),
        ),
        refusal=None,
    )


REFUSED = Outcome(figures=None, refusal=Refusal(code="too_few_photos", message="5 usable photos of 5."))

"""Summary of the spectra of a written cloud."""

from __future__ import annotations

from dataclasses import dataclass

from specimap_core.notices import Notice


@dataclass(frozen=True)
class WriteSummary:
    """Points of the cloud; those flagged SATURATED and NO_DATA; values of good bands that did not fit and were clipped
    to ``least`` or ``largest``, the ends of what the cloud can hold; those ``absurd`` ones that were left out."""

    points: int
    saturated: int
    no_data: int
    clipped_below: int
    clipped_above: int
    absurd: int
    least: float
    largest: float

    def warnings(self) -> list[Notice]:
        """Warnings for the report."""
        found: list[Notice] = []
        if self.no_data:
            text = f"{self.no_data} of {self.points} points lack a value in a good band; they are flagged (128)."
            found.append(Notice("points_no_data", text))
        if self.absurd:
            text = f"{self.absurd} values lie far beyond all others, as of dead pixels; they are taken for no value."
            found.append(Notice("values_absurd", text))
        if self.clipped_below:
            text = f"{self.clipped_below} values lie below {self.least:.4g} and were stored as that."
            found.append(Notice("values_clipped", text))
        if self.clipped_above:
            text = f"{self.clipped_above} values lie above {self.largest:.5g} and were stored as that; their points are"
            found.append(Notice("values_clipped", f"{text} flagged as saturated."))
        return found

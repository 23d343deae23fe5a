"""What a de-identified export calls things: pseudonyms that whoever holds the key has derived."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from specimap_core.errors import NotFoundError

FILE = "deidentify.json"


class Plan(BaseModel):
    """Pseudonyms and shifted days; ``photos``: the new name of each photo, without a suffix, by its name in results.

    ``inputs``: whether photos and cube are exported beside the result.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    specimen: str
    acquisition: str
    result: str
    captured: str
    made: str
    dictionary: str
    edge_mm: float
    photos: dict[str, str]
    inputs: bool

    @classmethod
    def read(cls, folder: Path) -> Plan:
        """Read the plan that lies in a folder. Raises NotFoundError."""
        try:
            return cls.model_validate_json((folder / FILE).read_text("utf-8"))
        except FileNotFoundError as error:
            raise NotFoundError(
                "There is no plan of pseudonyms.", advice="Ask the service for the export; its workers make the plan."
            ) from error

    def write(self, folder: Path) -> None:
        """Write it into a folder."""
        (folder / FILE).write_text(self.model_dump_json(), encoding="utf-8")

"""Judgement of a file that has arrived, given what its acquisition holds already."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from specimap_core.errors import CubeHeaderError
from specimap_infra.errors import JobConflictError
from specimap_infra.storage import Storage
from specimap_infra.tables import StoredFile
from specimap_service.acquisitions.judge import Judge
from specimap_service.acquisitions.schemas import CubeJudgement, Judged, PhotoJudgement
from specimap_service.auth.keys import Principal

OTHER_PART = {"header": "data", "data": "header"}
REFERENCES = ("white", "dark")


@dataclass(frozen=True)
class Arrival:
    """A file at ``path``, on the disk of the scratch folder; it is gone afterwards.

    ``principal`` where limits of number and quota are still to be checked; ``upload_id`` where it came by one, whose
    row is then finished in the same transaction.
    """

    file_id: str
    acquisition_id: str
    role: str
    name: str
    path: Path
    size: int
    sha256: str
    key_id: str
    principal: Principal | None = None
    upload_id: str | None = None


@dataclass(frozen=True)
class Known:
    """An acquisition as it stood when the judging began."""

    dictionary: str
    files: tuple[StoredFile, ...]

    def of_role(self, role: str) -> dict[str, StoredFile]:
        """Accepted files of a cube's or reference's role by part."""
        return {f.judgement["part"]: f for f in self.files if f.role == role and f.state == "accepted"}

    @property
    def photos(self) -> list[StoredFile]:
        """Accepted photos."""
        return [f for f in self.files if f.role == "photo" and f.state == "accepted"]


@dataclass(frozen=True)
class Findings:
    """The judgement of the file, and the new one of the other part of its cube."""

    suffix: str
    own: Judged
    other: tuple[StoredFile, CubeJudgement] | None = None


def judged(judge: Judge, storage: Storage, arrival: Arrival, known: Known, folder: Path) -> Findings:
    """Judge the file ``file`` in ``folder``, which holds nothing else.

    Raises:
        JobConflictError: the cube has this part already. NotFoundError: its other part was deleted meanwhile.
        BackendUnavailableError: nothing can be judged now.
    """
    if arrival.role == "photo":
        return _photo(judge, arrival, known, folder / "file")
    return _cube(judge, storage, arrival, known, folder)


def _photo(judge: Judge, arrival: Arrival, known: Known, path: Path) -> Findings:
    for photo in known.photos:
        if photo.sha256 == arrival.sha256:
            own = PhotoJudgement.model_validate(photo.judgement).model_copy(
                update={
                    "verdict": "refused",
                    "code": "photo_duplicate",
                    "reason": f"It is the same file as {photo.label}.",
                    "advice": "Take another photo, from another side.",
                    "same_as": photo.label,
                }
            )
            return Findings(PurePosixPath(photo.label).suffix, own)
    others = [PhotoJudgement.model_validate(photo.judgement) for photo in known.photos]
    sharpness = [j.sharpness for j in others if j.sharpness is not None and j.code != "photo_blurred"]
    sizes = [(j.width, j.height) for j in others if j.width is not None and j.height is not None]
    verdict = judge.photo(path, known.dictionary, sharpness, sizes, arrival.key_id)
    return Findings(verdict.pop("suffix"), PhotoJudgement.model_validate(verdict))


def _cube(judge: Judge, storage: Storage, arrival: Arrival, known: Known, folder: Path) -> Findings:
    there = known.of_role(arrival.role)
    header = there.get("header")
    expected = None if header is None else header.judgement.get("expected_bytes")
    claimed = PurePosixPath(arrival.name).suffix.lower()
    verdict = judge.part(folder / "file", claimed, expected, arrival.key_id)
    suffix: str = verdict.pop("suffix")
    own = CubeJudgement.model_validate(verdict)
    if own.verdict == "refused":
        return Findings(suffix, own)
    _check_free(arrival.role, own.part, there)
    path = folder / f"{arrival.role}{suffix}"
    (folder / "file").rename(path)
    if own.part == "whole":
        own = CubeJudgement.model_validate({"part": "whole", **judge.cube(path, arrival.key_id)})
        return Findings(suffix, _fitted(arrival.role, own, known))
    other = there.get(OTHER_PART[own.part])
    if other is None:
        own = own.model_copy(update={"waiting_for": OTHER_PART[own.part]})
        return Findings(suffix, _fitted(arrival.role, own, known))
    storage.fetch(other.storage_key, folder / other.label)
    pair = judge.cube(folder / f"{arrival.role}.hdr", arrival.key_id)
    own, others = _paired(own, CubeJudgement.model_validate(other.judgement), pair)
    return Findings(suffix, _fitted(arrival.role, own, known), (other, _fitted(arrival.role, others, known)))


def _paired(own: CubeJudgement, other: CubeJudgement, pair: dict[str, Any]) -> tuple[CubeJudgement, CubeJudgement]:
    """Both parts' judgements from that of the pair: where it is refused, one part is to blame."""
    words = {name: pair[name] for name in ("verdict", "code", "reason", "advice")}
    facts = {name: value for name, value in pair.items() if name in CubeJudgement.model_fields and name not in words}
    if pair["verdict"] != "refused":
        update = {**words, **facts, "waiting_for": None}
        return _updated(own, update), _updated(other, update)
    blamed = "header" if pair["code"] == CubeHeaderError.code else "data"
    waiting = {
        **words,
        "verdict": "doubtful",
        "waiting_for": blamed,
        "reason": f"The {blamed} beside it cannot be used. {pair['reason']}",
    }
    if own.part == blamed:
        kept = {"verdict": "accepted", "code": None, "reason": "", "advice": "", "waiting_for": blamed}
        return _updated(own, {**words, **facts, "waiting_for": None}), _updated(other, kept)
    return _updated(own, waiting), _updated(other, {**words, **facts, "waiting_for": None})


def _updated(judgement: CubeJudgement, update: dict[str, Any]) -> CubeJudgement:
    return CubeJudgement.model_validate({**judgement.model_dump(), **update})


def _check_free(role: str, part: str, there: dict[str, StoredFile]) -> None:
    taken = there.get("whole") or there.get(part) or (next(iter(there.values()), None) if part == "whole" else None)
    if taken is None:
        return
    what = "cube" if role == "cube" else f"{role} reference"
    raise JobConflictError(
        f"The acquisition has this part of a {what} already: {taken.label}.",
        advice=f"Delete {taken.label} first, then upload this one.",
        label=taken.label,
        file_id=taken.id,
    )


def _fitted(role: str, own: CubeJudgement, known: Known) -> CubeJudgement:
    """Whether cube and references have the same columns and bands, as far as they are there."""
    if own.cols is None or own.verdict == "refused":
        return own
    shapes = {}
    for other in ("cube", *REFERENCES):
        for row in known.of_role(other).values():
            if row.judgement.get("cols") is not None:
                shapes[other] = (row.judgement["cols"], row.judgement["bands"])
    for other in REFERENCES if role == "cube" else ("cube",):
        if other not in shapes:
            continue
        reference, cube = (
            (shapes[other], (own.cols, own.bands)) if role == "cube" else ((own.cols, own.bands), shapes[other])
        )
        if reference[1] == cube[1] and reference[0] in (1, cube[0]):
            continue
        name = other if role == "cube" else role
        words = {
            "verdict": "doubtful" if role == "cube" else "refused",
            "code": "cube_content_invalid",
            "reason": f"The {name} reference has {reference[0]} columns and {reference[1]} bands, "
            f"the cube {cube[0]} and {cube[1]}.",
            "advice": f"Give the {name} reference that was recorded with the cube, with the same binning.",
        }
        return _updated(own, words)
    return own

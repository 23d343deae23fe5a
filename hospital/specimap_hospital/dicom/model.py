"""What goes into the DICOM objects of a result, and what comes out. Light: it loads no DICOM library."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

Kind = Literal[
    "photo",
    "top_view",
    "preview",
    "mesh",
    "measurements",
    "report",
    "key_objects",
    "reference_image",
    "parametric_map",
    "segmentation",
]
"""What an object is."""
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True)
class ResultSource:
    """A finished result on this machine.

    ``folder``: holds cloud.zarr, mesh.ply, report.json, corners.json, preview.png, and photos.jpg where there is one.
    ``photos``: the acquisition's photos as they were uploaded, by any name; the objects do not hold the names.
    ``specimen_id`` stands in the objects where the study context names no specimen. ``created``: when the result was
    made; the objects hold its date and time as they are, in no zone.
    """

    folder: Path
    photos: Mapping[str, Path]
    acquisition_id: str
    specimen_id: str
    cloud_id: str
    job_id: str
    created: datetime.datetime
    software_version: str

    def as_dict(self) -> dict[str, Any]:
        """As JSON values, for a process of its own."""
        return {
            **asdict(self),
            "folder": str(self.folder),
            "photos": {name: str(path) for name, path in self.photos.items()},
            "created": self.created.isoformat(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ResultSource:
        """From what :meth:`as_dict` gave."""
        return cls(
            **{
                **values,
                "folder": Path(values["folder"]),
                "photos": {name: Path(path) for name, path in values["photos"].items()},
                "created": datetime.datetime.fromisoformat(values["created"]),
            }
        )


@dataclass(frozen=True)
class DicomObject:
    """A DICOM file that was written. Its name and its ``kind`` (:data:`Kind`) hold no patient data."""

    sop_class_uid: str
    sop_instance_uid: str
    series_uid: str
    study_uid: str
    kind: str
    path: Path

    def as_dict(self) -> dict[str, str]:
        """As JSON values."""
        return {**asdict(self), "path": str(self.path)}

    @classmethod
    def from_dict(cls, values: Mapping[str, str]) -> DicomObject:
        """From what :meth:`as_dict` gave."""
        return cls(**{**values, "path": Path(values["path"])})  # type: ignore[arg-type]


@dataclass(frozen=True)
class LeftOut:
    """A photo that is in no object, and why: its place among the photos, from 1, and the error's code and message.

    ``message`` may hold the name of the photo's file.
    """

    photo: int
    code: str
    message: str


@dataclass(frozen=True)
class SegmentClass:
    """A class of a label layer: its number in the layer, what it is called, and its colour as ``#rrggbb``."""

    value: int
    name: str
    colour: str | None = None


@dataclass(frozen=True)
class BandChoice:
    """What a parametric map shows: ``bands`` of the cloud by index, or the class probabilities of a layer.

    ``label`` names a layer of the cloud; ``columns`` are those of its probabilities that are wanted, each with a name.
    """

    bands: tuple[int, ...] = ()
    label: str | None = None
    columns: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class BuildTask:
    """What is to be built: the first set, or one of the objects on request; see :mod:`specimap_hospital.dicom.build`.

    ``choice`` of a parametric map; ``label`` and ``classes`` of a segmentation. ``archive``: the name of a ZIP of all
    objects that is written beside them.
    """

    what: Literal["first_set", "parametric_map", "segmentation"] = "first_set"
    choice: BandChoice = field(default_factory=BandChoice)
    label: str = ""
    classes: tuple[SegmentClass, ...] = ()
    archive: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """As JSON values, for a process of its own."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> BuildTask:
        """From what :meth:`as_dict` gave."""
        choice = values["choice"]
        return cls(
            what=values["what"],
            choice=BandChoice(
                tuple(choice["bands"]), choice["label"], {int(k): name for k, name in choice["columns"].items()}
            ),
            label=values["label"],
            classes=tuple(SegmentClass(**item) for item in values["classes"]),
            archive=values["archive"],
        )

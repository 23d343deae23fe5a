"""Stage 1 behind one Protocol: photos and corners in, cameras and depth out."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from specimap_core.errors import DuplicateMarkersError, NoMarkersFoundError, WrongDictionaryError
from specimap_core.fiducials.detection import (
    Detection,
    find_markers,
    fitting_dictionaries,
    measured_at,
    shared_sightings,
    tone_of,
)
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.notices import Notices
from specimap_core.photos.reading import Photo, Refusal
from specimap_core.reconstruct.dense.settings import DepthSettings

if TYPE_CHECKING:
    from specimap_core.reconstruct.poses_from_markers import MarkerSolution

CORNER_FLOOR_PX = 0.05
"""Least standard deviation of a corner: what neighbouring profiles share does not show in their scatter."""
LEAST_TONE = 0.02
"""Tones nearer to one move an edge by less than a hundredth of a pixel."""

DICTIONARY_SAMPLE = 4
"""Photos that other dictionaries are tried on."""
DICTIONARY_FACTOR = 3
"""Another dictionary must read this many times more markers than the given one."""

Progress = Callable[[float], None]
FeatureChoice = Literal["auto", "sift", "aliked"]


@dataclass(frozen=True)
class ReconstructSettings:
    """Stage 1. ``dictionary``: the markers' family. ``edge_mm``: their edge. ``backend``: which backend.
    ``features``: what locates photos that the markers leave open. ``hold_to_markers``: whether cameras and depth that a
    backend found without the markers are adjusted to them, or only brought to their frame and scale."""

    dictionary: str = "DICT_4X4_50"
    edge_mm: float = 6.8
    backend: str = "colmap"
    features: FeatureChoice = "auto"
    hold_to_markers: bool = True
    depth: DepthSettings = field(default_factory=DepthSettings)
    seed: int = 0


@dataclass(frozen=True)
class CornersInPhotos:
    """All markers in all photos: ``seen.photo`` indexes the photos, ``seen.marker`` indexes ``marker_ids``
    (ascending). ``solution``: what they were solved to, where that was done already."""

    seen: Observations
    marker_ids: tuple[int, ...]
    solution: MarkerSolution | None = None


@dataclass(frozen=True)
class Reconstruction:
    """Stage 1's answer, in a frame and scale of the backend's choice.

    ``photos``: indices of the posed photos; ``poses``: their ``cam_from_world``; ``maps``: depth maps, whose
    ``photo`` counts in ``photos``; ``points`` (N, 3): sparse points; ``refused``: photos left out and why;
    ``warnings``: for the report.
    """

    photos: tuple[int, ...]
    lens: Intrinsics
    poses: tuple[Pose, ...]
    maps: tuple[DepthMap, ...]
    points: NDArray[np.float32]
    refused: tuple[Refusal, ...]
    warnings: Notices


class ReconstructionBackend(Protocol):
    """What turns photos into cameras and depth."""

    name: str

    def reconstruct(
        self,
        photos: list[Photo],
        corners: CornersInPhotos,
        settings: ReconstructSettings,
        *,
        workers: int,
        progress: Progress,
    ) -> Reconstruction:
        """Pose the photos and measure depth; raises leaves of SpecimapError."""
        ...


def corners_in_photos(photos: list[Photo], detections: list[list[Detection]], dictionary: str) -> CornersInPhotos:
    """Gather detections (one list a photo) and judge them as a whole.

    An id that shows twice in a photo is left out there; where that is the rule, it is an error. An id that one
    photo alone shows, while others are shared, is taken for a false reading.

    Raises:
        NoMarkersFoundError: no photo shows a marker, of this dictionary or any known one.
        WrongDictionaryError: another dictionary fits; the advice names it.
        DuplicateMarkersError: several markers carry one id.
    """
    twice: dict[int, int] = {}
    shown: dict[int, int] = {}
    rows: list[tuple[int, Detection]] = []
    for photo, found in enumerate(detections):
        ids = [d.marker_id for d in found]
        for marker_id in set(ids):
            shown[marker_id] = shown.get(marker_id, 0) + 1
            twice[marker_id] = twice.get(marker_id, 0) + (ids.count(marker_id) > 1)
        rows += [(photo, d) for d in found if ids.count(d.marker_id) == 1]
    duplicates = sorted(i for i, n in twice.items() if n >= 2 and n >= 0.3 * shown[i])
    if duplicates:
        raise DuplicateMarkersError(
            f"Marker id {', '.join(map(str, duplicates))} stands on more than one marker.",
            advice="Give every marker around the specimen an id of its own.",
            ids=duplicates,
        )
    shared = {i for i, n in shown.items() if n - twice[i] >= 2}
    rows = [(photo, d) for photo, d in rows if d.marker_id in shared]
    if len(rows) < len(photos):
        _refuse_unreadable(photos, rows, dictionary)
    if not rows:
        raise NoMarkersFoundError(
            f"No marker of {dictionary} shows in two of the photos.",
            advice="Place the printed markers around the specimen, flat and wholly in view, and photograph again.",
            dictionary=dictionary,
        )
    ids_used = tuple(sorted({d.marker_id for _, d in rows}))
    index = {marker_id: k for k, marker_id in enumerate(ids_used)}
    seen = Observations(
        np.array([photo for photo, _ in rows]),
        np.array([index[d.marker_id] for _, d in rows]),
        np.stack([d.corners_px for _, d in rows]),
        np.hypot(np.array([d.sigma_px for _, d in rows]), CORNER_FLOOR_PX),
    )
    return CornersInPhotos(seen, ids_used)


def _refuse_unreadable(photos: list[Photo], rows: list[tuple[int, Detection]], dictionary: str) -> None:
    """Where few markers show: do far more read in the photos' mirror images, or in another dictionary?

    A wrong one reads a false marker now and then.
    """
    few = range(0, len(photos), max(1, len(photos) // DICTIONARY_SAMPLE))
    images = [photos[p].grey for p in few]
    many = DICTIONARY_FACTOR * max(sum(photo in few for photo, _ in rows), 1)
    mirrored = shared_sightings([np.ascontiguousarray(image[:, ::-1]) for image in images], dictionary)
    fitting = fitting_dictionaries(images)
    # In dictionaries of few bits, mirror images of another one's markers read, too.
    if mirrored > max([many, *fitting.values()]):
        raise NoMarkersFoundError(
            f"The photos are mirrored: markers of {dictionary} read in their mirror images only.",
            advice="Take the photos with the phone's rear camera, and do not flip them.",
            dictionary=dictionary,
        )
    fitting = {name: seen for name, seen in fitting.items() if seen > many}
    if not fitting:
        return
    best = next(iter(fitting))
    raise WrongDictionaryError(
        f"{len(rows) or 'No'} markers of {dictionary} show in the photos, but many of {best} do.",
        advice=f"Run again with the dictionary {best}, or a smaller one of its family.",
        dictionary=dictionary,
        fitting=fitting,
    )


def detect_in_photos(
    photos: list[Photo], dictionary: str, *, workers: int, progress: Progress
) -> list[list[Detection]]:
    """Markers of every photo, in order, measured at the tone that the photos share; several photos at a time."""
    expected = 4  # the published layout; a photo that shows fewer is searched a second time, enlarged
    found: list[list[Detection]] = []
    with ThreadPoolExecutor(workers) as pool:
        for one in pool.map(lambda p: find_markers(p.grey, dictionary, expected=expected), photos):
            found.append(one)
            progress(0.8 * len(found) / len(photos))
        tone = tone_of([p.grey for p in photos], found, dictionary, workers=workers)
        tone = tone if abs(tone - 1) > LEAST_TONE else 1.0
        measured = list(pool.map(lambda photo, one: measured_at(photo.grey, one, tone), photos, found))
    progress(1.0)
    return measured


def sparse_points(maps: list[DepthMap], poses: tuple[Pose, ...], per_map: int = 200) -> NDArray[np.float32]:
    """A thin, even sample of the depth maps' points (N, 3), for the report and for checks."""
    parts = [m.points(poses[m.photo], per_map) for m in maps]
    return np.concatenate(parts or [np.zeros((0, 3))]).astype(np.float32)

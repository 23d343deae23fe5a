"""Resection of photos without a pose, by features triangulated from the posed photos.

Features are matched between neighbours in viewing angle, triangulated with the known poses, and a photo without a
pose is then resected by LO-RANSAC (COLMAP). Each pair of photos is matched once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.colmap_cameras import colmap_camera, colmap_from_opencv
from specimap_core.geometry.triangulation import triangulate_pair
from specimap_core.native import quiet_colmap
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.features.base import FeatureKind, Features, Pairs
from specimap_core.reconstruct.features.sift import match

RESECTION_PX = 4.0
NEAREST = 4
"""Photos that a photo with a rough pose is compared with, for each such pose."""

TRIANGULATION_PARTNERS = 4
"""Neighbours that a posed photo's features are triangulated with, where they are matched already; two otherwise."""

Tick = Callable[[], None]
TurnedPhoto = tuple[int, int]
"""A photo, and the quarter turn in which it was described."""


@dataclass(frozen=True)
class ResectedPose:
    """A photo's resected pose with the number and share of matches that agree, and the quarter ``turn`` in which its
    features were described."""

    pose: Pose
    inliers: int
    share: float
    turn: int = 0


class Locator:
    """Locates photos against those already posed. ``tick`` is called between steps and may raise to stop."""

    def __init__(
        self,
        photos: list[Photo],
        lens: Intrinsics,
        poses: dict[int, Pose],
        target: Floats,
        seed: int,
        kind: FeatureKind,
        tick: Tick = lambda: None,
    ) -> None:
        quiet_colmap()
        self._photos = photos
        self._lens = lens
        self._target = target
        self._seed = seed
        self._kind = kind
        self._tick = tick
        self._least_inliers = kind.least_inliers
        self._features: dict[TurnedPhoto, Features] = {}
        self._turn: dict[int, int] = {}  # of posed photos that were found turned
        self._points: dict[int, Floats] = {}  # photo -> (N, 3), NaN where a feature has no place
        self._matches: dict[tuple[TurnedPhoto, TurnedPhoto], Pairs] = {}
        self._similarities: dict[tuple[TurnedPhoto, TurnedPhoto], int] = {}
        self._failed: dict[TurnedPhoto, list[int]] = {}  # what a photo was last compared with in vain
        self.poses = dict(poses)

    def begin(self, poses: dict[int, Pose], least_inliers: int) -> None:
        """Try anew, with what is known by now: photos described and matched before are not described again.

        ``least_inliers``: how many matches must agree on a pose, where that is more than the kind of features asks for.
        """
        self.poses.update(poses)
        self._least_inliers = max(self._kind.least_inliers, least_inliers)
        self._failed.clear()

    def _extract(self, photos: Iterable[int], turn: int = 0) -> None:
        missing = [p for p in photos if (p, turn) not in self._features]
        for photo, found in zip(missing, self._kind.extract([self._photos[p] for p in missing], turn), strict=True):
            self._features[photo, turn] = found
            self._tick()

    def _extract_posed(self, photos: Iterable[int]) -> None:
        # One that was found turned was described in that turn before it was posed.
        self._extract(p for p in photos if p not in self._turn)

    def _in_its_turn(self, photo: int) -> TurnedPhoto:
        return photo, self._turn.get(photo, 0)

    def _match(self, pairs: Sequence[tuple[TurnedPhoto, TurnedPhoto]]) -> list[Pairs]:
        """Matches of each pair; what was matched before, either way around, is not matched again."""
        new = [p for p in pairs if p not in self._matches]
        found = self._kind.match([(self._features[a], self._features[b]) for a, b in new])
        for (a, b), matches in zip(new, found, strict=True):
            self._matches[a, b], self._matches[b, a] = matches, matches[:, ::-1]
            self._tick()
        return [self._matches[p] for p in pairs]

    def _similarity(self, a: TurnedPhoto, b: TurnedPhoto) -> int:
        """How many descriptors agree, places aside: cheap, where a learned matcher is expensive."""
        if (a, b) not in self._similarities:
            # Where the kind matches by descriptors alone, this is its match.
            plain = self._kind.shortlist is None
            count = len(self._match([(a, b)])[0] if plain else match(self._features[a], self._features[b]))
            self._similarities[a, b] = self._similarities[b, a] = count
        return self._similarities[a, b]

    def _triangulate_features(self, photos: Iterable[int]) -> None:
        """Triangulate the features of posed photos with their neighbours, once."""
        order = tuple(sorted(self.poses))
        poses = tuple(self.poses[p] for p in order)
        new = [p for p in photos if p not in self._points]
        if not new:
            return
        near = choose_pairs(poses, self._target, DepthSettings(pairs_per_photo=TRIANGULATION_PARTNERS))
        partners = {a: [order[j] for i, j in near if order[i] == a] for a in new}
        self._extract_posed({q for b in partners.values() for q in b} | set(new))
        pairs = []
        for a, others in partners.items():
            self._points[a] = np.full((len(self._features[self._in_its_turn(a)].xy), 3), np.nan)
            known = [b for b in others if (self._in_its_turn(a), self._in_its_turn(b)) in self._matches]
            pairs += [(a, b) for b in known or others[:2]]
        found = self._match([(self._in_its_turn(a), self._in_its_turn(b)) for a, b in pairs])
        for (a, b), matches in zip(pairs, found, strict=True):
            self._triangulate(a, b, matches)

    def _triangulate(self, a: int, b: int, pairs: Pairs) -> None:
        if not len(pairs):
            return
        xy = self._features[self._in_its_turn(a)].xy[pairs[:, 0]], self._features[self._in_its_turn(b)].xy[pairs[:, 1]]
        points, good = triangulate_pair(self._lens, (self.poses[a], self.poses[b]), xy)
        self._points[a][pairs[good, 0]] = points[good]
        if b in self._points:
            self._points[b][pairs[good, 1]] = points[good]

    def nearest_by_direction(self, poses: Iterable[Pose]) -> set[int]:
        """The posed photos that look from about where a photo with one of ``poses`` would."""
        known = np.array(sorted(self.poses))
        sights = np.stack([self._viewing_direction(self.poses[int(p)]) for p in known])
        towards = [sights @ self._viewing_direction(pose) for pose in poses]
        return {int(p) for cosine in towards for p in known[np.argsort(-cosine)[:NEAREST]]}

    def _viewing_direction(self, pose: Pose) -> Floats:
        away = pose.centre - self._target
        return np.asarray(away / np.linalg.norm(away))

    def most_similar_first(self, photos: Sequence[int]) -> list[int]:
        """``photos`` by how much they look like the posed photo that looks most like them."""
        self._extract_posed(self.poses)
        self._extract(photos)
        alike: dict[int, int] = {}
        for p in photos:
            alike[p] = max(self._similarity((p, 0), self._in_its_turn(q)) for q in self.poses)
            self._tick()
        return sorted(photos, key=lambda p: (-alike[p], p))

    def locate(self, photo: int, among: set[int] | None = None, *, turned: bool = False) -> ResectedPose | None:
        """Resect a photo against the posed photos ``among``, all by default; None where too few matches agree.

        ``turned``: in the other quarter turns, where the kind of features does not see through them.
        """
        others = set(self.poses) - {photo} if among is None else among - {photo}
        self._extract_posed(others)
        if not turned:
            return self._resect(photo, 0, others)
        alike = {}
        for turn in self._kind.turns:
            self._extract([photo], turn)
            alike[turn] = max(self._similarity((photo, turn), self._in_its_turn(p)) for p in others)
        turn = max(alike, key=lambda k: (alike[k], -k))
        return self._resect(photo, turn, others) if turn else None

    def _resect(self, photo: int, turn: int, others: set[int]) -> ResectedPose | None:
        self._extract([photo], turn)
        mine = (photo, turn)
        chosen = sorted(others, key=lambda p: (-self._similarity(mine, self._in_its_turn(p)), p))[
            : self._kind.shortlist
        ]
        if self._failed.get(mine) == chosen:
            return None
        located = self._pose_from(mine, chosen)
        if located is None:
            self._failed[mine] = chosen
        return located

    def _pose_from(self, mine: TurnedPhoto, chosen: list[int]) -> ResectedPose | None:
        # Only what the photo is compared with: a learned matcher takes a quarter of a second for a pair.
        self._triangulate_features(chosen)
        features = self._features[mine]
        xy, places = [np.zeros((0, 2))], [np.zeros((0, 3))]
        for other, pairs in zip(chosen, self._match([(mine, self._in_its_turn(p)) for p in chosen]), strict=True):
            at = self._points[other][pairs[:, 1]]
            placed = np.isfinite(at).all(1)
            xy.append(features.xy[pairs[placed, 0]])
            places.append(at[placed])
        points_2d, points_3d = np.concatenate(xy), np.concatenate(places)
        if len(points_2d) < self._least_inliers:
            return None
        pycolmap.set_random_seed(self._seed)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = RESECTION_PX
        options.ransac.random_seed = self._seed
        answer = pycolmap.estimate_and_refine_absolute_pose(
            colmap_from_opencv(points_2d), points_3d, colmap_camera(self._lens), options
        )
        self._tick()
        if answer is None:
            return None
        inliers = int(answer["num_inliers"])
        if inliers < self._least_inliers or inliers < self._kind.least_share * len(points_2d):
            return None
        matrix = answer["cam_from_world"].matrix()
        pose = Pose(matrix[:, :3].copy(), matrix[:, 3].copy())
        if pose.centre[2] <= self._target[2]:
            return None  # it would look from below the specimen
        return ResectedPose(pose, inliers, inliers / len(points_2d), mine[1])

    def add(self, photo: int, pose: Pose, turn: int = 0) -> None:
        """Count a photo as posed; its features, described in that quarter turn, take part from now on."""
        self.poses[photo] = pose
        if turn:
            self._turn[photo] = turn

    def feature_counts(self) -> tuple[list[int], list[int]]:
        """Features of each photo looked at, and how many of them have a place, for each posed photo."""
        found = [len(f.xy) for (_, turn), f in self._features.items() if not turn]
        placed = [int(np.isfinite(p).all(1).sum()) for p in self._points.values()]
        return found, placed

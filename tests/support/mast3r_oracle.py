"""A script for the child's process: upstream's alignment with a network that knows the answer.

It runs what :mod:`specimap_core.reconstruct.backends.mast3r.child` runs, upstream's code included, and puts an oracle
in the network's place: exact points in the first photo's frame, even confidence, and descriptors that are alike where
the points are near. ``ORACLE`` in the environment names an archive with ``images`` (N, H, W, 3) as the network gets
them, ``points`` (N, H, W, 3) in the world, ``poses`` (N, 3, 4) ``cam_from_world``, ``sure`` (N, H, W) from 0, where
nothing shows, to 1.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.mast3r_torchvision import stand_in

WAVES_MM = (400.0, 100.0, 25.0, 8.0)
"""Wavelengths of the descriptors: the longest tells places apart, the shortest points to a fraction of a pixel."""
METRES = 1e-3
SURE = 10.0


class Oracle(torch.nn.Module):  # type: ignore[misc]
    """Answers as upstream's network does, from an archive."""

    def __init__(self, path: str) -> None:
        super().__init__()
        with np.load(path) as stored:
            self._images = torch.from_numpy(stored["images"])
            self._points = torch.from_numpy(stored["points"]).float()
            self._poses = torch.from_numpy(stored["poses"]).float()
            self._sure = torch.from_numpy(stored["sure"]).float()
        phase = torch.cat([self._points * (2 * np.pi / wave) for wave in WAVES_MM], -1)
        features = torch.cat([phase.sin(), phase.cos()], -1)
        # Where nothing shows, one place looks like another.
        features = torch.where(self._sure[..., None] > 0, features, torch.ones_like(features))
        self._features = torch.nn.functional.normalize(features, dim=-1)

    def _recognise(self, image: torch.Tensor) -> torch.Tensor:
        pixels = ((image[0] * 0.5 + 0.5) * 255).round().to(torch.uint8).permute(1, 2, 0)
        (found,) = [k for k, known in enumerate(self._images) if torch.equal(known, pixels)]
        return torch.tensor([float(found)])

    def _encode_image_pairs(self, img1: Any, img2: Any, shape1: Any, shape2: Any) -> tuple[Any, ...]:
        return self._recognise(img1), self._recognise(img2), None, None

    def _decoder(self, first: Any, _pos1: Any, second: Any, _pos2: Any) -> tuple[list[Any], list[Any]]:
        return [torch.cat([first, first])], [torch.cat([second, first])]

    def _downstream_head(self, _number: int, tokens: list[Any], _shape: Any) -> dict[str, torch.Tensor]:
        photo, frame = (int(v) for v in tokens[0])
        pose = self._poses[frame]
        points = (self._points[photo] @ pose[:, :3].T + pose[:, 3]) * METRES
        sure = 1 + (SURE - 1) * self._sure[photo]
        return {
            "pts3d": points[None],
            "conf": sure[None],
            "desc": self._features[photo][None],
            "desc_conf": sure[None],
        }


def run(request: dict[str, Any], arrays: dict[str, Any], step: Any) -> Any:
    """As :func:`specimap_core.reconstruct.backends.mast3r.child.run`, with the oracle for a network."""
    from specimap_core.reconstruct.backends.mast3r import child

    stand_in()
    child.load_network = lambda request: Oracle(os.environ["ORACLE"])
    return child.run(request, arrays, step)

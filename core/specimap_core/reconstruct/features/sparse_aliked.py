"""ALIKED's network with its dense maps computed only where they are read: at the keypoints.

The package builds a map of 128 channels at full resolution, of which it needs one channel of scores everywhere and the
rest at some thousand places around the keypoints. On a CPU most of an extraction goes into that map: half of its time,
and 0.6 GB at 800 pixels. The weights and, up to rounding, the results are the package's.

Imports torch: nothing imports this module unless ALIKED is asked for.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample, interpolate, linear, normalize, pad
from torch.nn.utils.fusion import fuse_conv_bn_eval

Tensor = Any
DIVISOR = 32
"""The coarsest level has one pixel for so many of the image."""
NMS_ROUNDS = 2


class SparseAliked:
    """An ``ALIKED`` of the package in evaluation mode, changed in place, for one image at a time.

    It must have been made to find a fixed number of keypoints.
    """

    def __init__(self, network: Any) -> None:
        for block in (network.block1, network.block2):
            for k in (1, 2):
                convolution, norm = f"conv{k}", f"bn{k}"
                setattr(block, convolution, fuse_conv_bn_eval(getattr(block, convolution), getattr(block, norm)))
                setattr(block, norm, torch.nn.Identity())
        # Channels last: much of the time goes into operations across the channels of each pixel.
        self.network = network.to(memory_format=torch.channels_last)

    def __call__(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints (N, 2), x and y in pixels with centres at integers, and their descriptors (N, 128) of unit length.

        ``image``: (1, 3, H, W), RGB from 0 to 1.
        """
        levels = Levels(self.network, image)
        keypoints = self._detect(levels.scores())
        return keypoints, self._describe(levels, keypoints)

    def _detect(self, scores: Tensor) -> Tensor:
        """The highest of the scores (H, W) that no neighbour exceeds, each moved to the soft maximum around it."""
        detector = self.network.dkd
        radius, width = detector.radius, scores.shape[1]
        peaks = torch.from_numpy(suppressed(scores.contiguous().numpy(), radius))
        inner = torch.zeros_like(peaks)
        inner[radius:-radius, radius:-radius] = peaks[radius:-radius, radius:-radius]
        index = torch.topk(inner.flatten(), min(detector.top_k, inner.numel())).indices
        xy = torch.stack([index % width, torch.div(index, width, rounding_mode="trunc")], -1)
        grid = detector.hw_grid
        near = xy[:, None] + grid.long()
        # A place outside the image counts as a score of zero, as in the package.
        rows, cols = near[..., 1].clamp(0, scores.shape[0] - 1), near[..., 0].clamp(0, width - 1)
        around = scores[rows, cols] * ((rows == near[..., 1]) & (cols == near[..., 0]))
        weights = ((around - around.amax(1, keepdim=True)) / detector.temperature).exp()
        return xy + weights @ grid / weights.sum(1, keepdim=True)

    def _describe(self, levels: Levels, keypoints: Tensor) -> Tensor:
        """Descriptors (N, 128) from features at places around each keypoint that the network chooses."""
        head = self.network.desc_head
        n, size = len(keypoints), head.kernel_size
        patch = levels.features(_patch_pixels(keypoints, size, levels.width, levels.height))
        furthest = max(levels.height, levels.width) / 4
        offset = head.offset_conv(patch.reshape(n, size, size, -1).permute(0, 3, 1, 2)).clamp(-furthest, furthest)
        offset = offset[:, :, 0, 0].view(n, 2, head.n_pos).permute(0, 2, 1)
        places = levels.sampled((keypoints[:, None] + offset).reshape(-1, 2))
        places = places.reshape(n, head.n_pos, -1).permute(0, 2, 1)[..., None]
        seen = torch.selu_(head.sf_conv(places)).squeeze(-1)
        return normalize(torch.einsum("ncp,pcd->nd", seen, head.agg_weights), p=2.0, dim=1)


class Levels:
    """The network's four levels for one image, each (1, C, h, w), and what the full-size map would hold at a pixel."""

    def __init__(self, network: Any, image: Tensor) -> None:
        self.height, self.width = image.shape[-2:]
        down, across = -self.height % DIVISOR, -self.width % DIVISOR
        self._top, self._left = down // 2, across // 2
        padded = pad(image, (self._left, across - self._left, self._top, down - self._top), mode="replicate")
        self._rows, self._cols = padded.shape[-2:]
        one = network.block1(padded)
        two = network.block2(network.pool2(one))
        three = network.block3(network.pool4(two))
        four = network.block4(network.pool4(three))
        convolutions = (network.conv1, network.conv2, network.conv3, network.conv4)
        self._levels = [
            network.gate(across_channels(x, f.weight))
            for f, x in zip(convolutions, (one, two, three, four), strict=True)
        ]
        self._head = network.score_head

    def scores(self) -> Tensor:
        """How well each pixel (H, W) would serve as a keypoint, from 0 to 1."""
        # The head begins with a convolution over the channels of a pixel. It commutes with the interpolation, so that
        # each level is enlarged with its 8 outputs instead of its 32 channels.
        total, at = None, 0
        for level in self._levels:
            channels = level.shape[1]
            part = across_channels(level, self._head[0].weight[:, at : at + channels])
            at += channels
            if total is None:
                total = part
            else:
                total += interpolate(part, (self._rows, self._cols), mode="bilinear", align_corners=True)
        score = torch.sigmoid(self._head[1:](total))[0, 0]
        return score[self._top : self._top + self.height, self._left : self._left + self.width]

    def features(self, xy: Tensor) -> Tensor:
        """Features (N, 128) of unit length at whole pixels ``xy`` (N, 2) of the image."""
        col, row = xy[:, 0] + self._left, xy[:, 1] + self._top
        grid = torch.stack([2 * col / (self._cols - 1) - 1, 2 * row / (self._rows - 1) - 1], -1)[None, :, None]
        finest, *others = self._levels
        parts = [finest[0].permute(1, 2, 0)[row, col]]
        parts += [grid_sample(level, grid, mode="bilinear", align_corners=True)[0, :, :, 0].T for level in others]
        return normalize(torch.cat(parts, -1), p=2.0, dim=1)

    def sampled(self, xy: Tensor) -> Tensor:
        """Features (N, 128) between pixels, bilinear; zero outside the image."""
        low = xy.floor()
        share = xy - low
        result = 0
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            corner = low.long() + torch.tensor([dx, dy])
            inside = (corner >= 0).all(1) & (corner[:, 0] < self.width) & (corner[:, 1] < self.height)
            weight = (share[:, 0] if dx else 1 - share[:, 0]) * (share[:, 1] if dy else 1 - share[:, 1])
            corner = torch.stack([corner[:, 0].clamp(0, self.width - 1), corner[:, 1].clamp(0, self.height - 1)], -1)
            result = result + self.features(corner) * (weight * inside)[:, None]
        return result


def across_channels(x: Tensor, weight: Tensor) -> Tensor:
    """A 1 x 1 convolution of x (1, C, h, w) by ``weight`` (D, C, 1, 1): one matrix product with channels last."""
    return linear(x.permute(0, 2, 3, 1), weight[:, :, 0, 0]).permute(0, 3, 1, 2)


def suppressed(scores: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    """The scores (H, W) where none within ``radius`` rows and columns is higher, zero elsewhere.

    What is left between two maxima gets two more chances, as in SuperPoint (DeTone 2018).
    """
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    peak = scores == cv2.dilate(scores, window)
    for _ in range(NMS_ROUNDS):
        taken = cv2.dilate(peak.view(np.uint8), window) > 0
        rest = np.where(taken, np.float32(0), scores)
        peak |= (rest == cv2.dilate(rest, window)) & ~taken
    return np.where(peak, scores, np.float32(0))


def _patch_pixels(keypoints: Tensor, size: int, width: int, height: int) -> Tensor:
    """Pixels (N size size, 2) of the square around each keypoint, row by row, moved so that it lies in the image."""
    corner = (keypoints.long() - size / 2 + 1).long()
    corner = torch.stack([corner[:, 0].clamp(0, width - 1 - size), corner[:, 1].clamp(0, height - 1 - size)], -1)
    steps = torch.arange(size)
    square = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    return (corner[:, None] + square).reshape(-1, 2)

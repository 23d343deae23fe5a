"""Deformable convolution (Dai 2017) in torch's own operations, and torchvision's place where that is absent.

ALIKED's code takes one operator, and two short helpers, from torchvision. Its builds carry compiled code that fits
one build of torch only; where none fits, or none is installed, a stand-in of these three takes its place, and only
while ALIKED's code is imported. Imports torch: nothing imports this module unless ALIKED is asked for.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch.nn.functional import grid_sample

NAMES = ("torchvision", "torchvision.models", "torchvision.models.resnet")

Tensor = Any


def deform_conv2d(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    stride: int | tuple[int, int] = 1,
    padding: int | tuple[int, int] = 0,
    dilation: int | tuple[int, int] = 1,
    mask: Tensor | None = None,
) -> Tensor:
    """What ``torchvision.ops.deform_conv2d`` computes, for one group of channels and of offsets.

    ``input`` (B, C, H, W); ``offset`` (B, 2 kh kw, H', W'): for each tap of the kernel, row by row, how far down and
    how far right of its usual place it reads, pixels; ``weight`` (D, C, kh, kw); ``bias`` (D,); ``mask`` (B, kh kw,
    H', W'). Between pixels it reads bilinearly, outside the input zeros. Returns (B, D, H', W').

    Raises ValueError where the shapes do not fit, as with several groups.
    """
    (sy, sx), (py, px), (dy, dx) = _pair(stride), _pair(padding), _pair(dilation)
    b, c, h, w = input.shape
    d, channels, kh, kw = weight.shape
    out_h = (h + 2 * py - dy * (kh - 1) - 1) // sy + 1
    out_w = (w + 2 * px - dx * (kw - 1) - 1) // sx + 1
    if channels != c or tuple(offset.shape) != (b, 2 * kh * kw, out_h, out_w):
        raise ValueError(f"shapes do not fit one group: {input.shape}, {offset.shape}, {weight.shape}")
    like = {"dtype": input.dtype, "device": input.device}
    rows = (torch.arange(out_h, **like) * sy - py)[:, None]
    cols = (torch.arange(out_w, **like) * sx - px)[None, :]
    result = torch.zeros((b, d, out_h, out_w), **like)
    # One tap at a time: all nine at once would hold nine copies of the input.
    for tap in range(kh * kw):
        y = rows + dy * (tap // kw) + offset[:, 2 * tap]
        x = cols + dx * (tap % kw) + offset[:, 2 * tap + 1]
        grid = torch.stack([2 * x / max(w - 1, 1) - 1, 2 * y / max(h - 1, 1) - 1], -1)
        read = grid_sample(input, grid, mode="bilinear", padding_mode="zeros", align_corners=True)
        if mask is not None:
            read = read * mask[:, tap : tap + 1]
        result = result + torch.einsum("bchw,dc->bdhw", read, weight[:, :, tap // kw, tap % kw])
    return result if bias is None else result + bias[:, None, None]


def _pair(value: int | tuple[int, int]) -> tuple[int, int]:
    return (value, value) if isinstance(value, int) else (value[0], value[1])


def conv3x3(inputs: int, outputs: int, stride: int = 1) -> Any:
    """A 3 x 3 convolution without bias, padded to keep the size."""
    return torch.nn.Conv2d(inputs, outputs, kernel_size=3, stride=stride, padding=1, bias=False)


def conv1x1(inputs: int, outputs: int, stride: int = 1) -> Any:
    """A 1 x 1 convolution without bias."""
    return torch.nn.Conv2d(inputs, outputs, kernel_size=1, stride=stride, bias=False)


def torchvision_imports() -> bool:
    """Whether torchvision is there and fits this torch."""
    try:
        importlib.import_module("torchvision.ops")
        importlib.import_module("torchvision.models.resnet")
    except (ImportError, RuntimeError, OSError):  # a build for another torch raises RuntimeError
        return False
    return True


@contextmanager
def in_torchvisions_place() -> Iterator[None]:
    """Inside, ``import torchvision`` gives the stand-in; afterwards the modules are as they were."""
    before = {name: module for name, module in sys.modules.items() if name.partition(".")[0] == "torchvision"}
    stand_in = {name: ModuleType(name) for name in NAMES}
    top, models, resnet = stand_in.values()
    vars(top).update(ops=SimpleNamespace(deform_conv2d=deform_conv2d), models=models)
    vars(models).update(resnet=resnet)
    vars(resnet).update(conv1x1=conv1x1, conv3x3=conv3x3)
    for name in before:
        del sys.modules[name]
    sys.modules.update(stand_in)
    try:
        yield
    finally:
        for name in NAMES:
            sys.modules.pop(name, None)
        sys.modules.update(before)
